"""Everything that an operator may set, read from the environment (prefix ``SMSR_``)."""

from __future__ import annotations

import base64
import functools
import ipaddress
import json
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal
from urllib.parse import urlsplit

from pydantic import AliasChoices, Field, ValidationError, field_validator
from pydantic_core import PydanticCustomError
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict
from redis.connection import parse_url

from worker.cgroup import available_cores, memory_limit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pydantic_core import ErrorDetails

GIBIBYTE = 1 << 30
DAY = 86400

_WORKER_BYTES = 192 << 20
"""What a worker takes beside its job: the supervisor, the keeper and BLAS's buffers, measured."""
_LEAST_BYTES = 64 << 20


class WrongSettings(Exception):
    """Settings with which nothing can run.

    Parameters
    ----------
    problems : sequence of str
        A line for each: the variable, what is wrong and what would be right, and no secrets.
    """

    def __init__(self, problems: Sequence[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = tuple(problems)


class Settings(BaseSettings):
    """Settings of the queue and its workers.

    Each field can be given as an environment variable ``SMSR_<FIELD>``; the Redis address also as
    the customary ``REDIS_URL``. Without one an embedded server is meant (`worker.redis_server`).
    """

    model_config = SettingsConfigDict(
        env_prefix="SMSR_",
        frozen=True,
        extra="ignore",
        populate_by_name=True,
        hide_input_in_errors=True,  # there are secrets among them
    )

    data_dir: Path = Field(
        default=Path("smsr-data"),
        description="Folder of the embedded Redis server, of the objects and of scratch files.",
    )
    redis_url: str | None = Field(
        default=None,
        validation_alias=AliasChoices("SMSR_REDIS_URL", "REDIS_URL"),
        repr=False,  # it may have a password
        description="redis://, rediss:// or unix:// address of Redis 6.2 or later.",
    )
    storage_url: str | None = Field(
        default=None,
        description="Where inputs and results are kept: file:///folder or s3://bucket/prefix. "
        "Without it a folder in the data folder.",
    )
    scratch_dir: Path | None = Field(
        default=None,
        description="Folder for the files of a running job; without it a folder in the data folder."
        " Results move into file:// storage without a copy where both share a file system.",
    )

    presigned_links_seconds: int | None = Field(
        default=None,
        ge=1,
        le=7 * DAY,
        description="Where set and results are in S3, arrays are not passed through the API: it "
        "redirects to signed addresses of the store that are good for so long.",
    )

    min_free_bytes: int = Field(
        default=GIBIBYTE,
        ge=0,
        description="Room that uploads leave on the disks of a file:// storage and of the scratch "
        "folder, so that running jobs can finish; 0 lets them fill the disk.",
    )
    max_upload_bytes: int = Field(default=4 * GIBIBYTE, gt=0, description="Largest upload.")
    max_array_bytes: int = Field(
        default=16 * GIBIBYTE, gt=0, description="Largest array, decompressed."
    )
    job_timeout_seconds: float = Field(
        default=3600, gt=0, description="Longest run of one job; a job may ask for less."
    )
    result_ttl_seconds: float = Field(
        default=7 * DAY, ge=0, description="How long a finished job is kept; 0 keeps it for ever."
    )
    max_ttl_seconds: float = Field(
        default=30 * DAY,
        ge=0,
        description="Longest time for which a job may ask to be kept; 0 sets no limit. A job may "
        "always ask for `result_ttl_seconds`.",
    )
    reuse_results: bool = Field(
        default=True,
        description="Whether a job that does not say takes the result of an equal one.",
    )
    idempotency_seconds: float = Field(
        default=DAY, gt=0, description="How long an Idempotency-Key is remembered."
    )
    upload_ttl_seconds: float = Field(
        default=DAY,
        gt=0,
        description="How long an upload that no job has taken is kept after its last byte.",
    )
    orphan_grace_seconds: float = Field(
        default=DAY,
        gt=0,
        description="Age after which stored objects that belong to no job are removed.",
    )

    queue: str = Field(default="smsr", pattern=r"^[A-Za-z0-9_-]+$", description="Name in RQ.")
    workers: int = Field(default=1, ge=1, description="Worker processes on this machine.")
    threads: int | None = Field(
        default=None, ge=1, description="BLAS threads of a worker; without it cores / workers."
    )

    job_memory_bytes: int | None = Field(
        default=None,
        gt=0,
        description="Memory that one job may take; without it what the container or unit leaves.",
    )
    max_attempts: int = Field(
        default=12, ge=1, description="Starts of a job whose workers keep dying before it fails."
    )
    lease_seconds: float = Field(
        default=6, gt=0, description="Silence after which a worker is taken for dead."
    )
    heartbeat_seconds: float = Field(
        default=1, gt=0, description="How often a worker renews its lease and looks after its job."
    )
    cancel_grace_seconds: float = Field(
        default=3, ge=0, description="Time a cancelled job has to stop by itself before a SIGKILL."
    )
    shutdown_grace_seconds: float = Field(
        default=5, ge=0, description="Time a stopping worker leaves its job before handing it back."
    )
    progress_interval_seconds: float = Field(
        default=0.25, ge=0, description="Shortest time between two progress reports."
    )
    storage_retry_seconds: float = Field(
        default=60, ge=0, description="How long a failing storage is tried before a job is re-run."
    )
    maintenance_interval_seconds: float = Field(
        default=1, gt=0, description="Time between two looks for lost and expired jobs."
    )
    lost_ticket_seconds: float = Field(
        default=4, gt=0, description="Time a queued job may be without a place in RQ."
    )

    access: Literal["auto", "open", "keys"] = Field(
        default="auto",
        description="Who may use the API: 'keys' is whoever has an API key, 'open' whoever reaches "
        "it; 'auto' is open to this machine where the API listens on a loopback address, else "
        "'keys'.",
    )
    key_requests_per_minute: int = Field(
        default=600, ge=0, le=100_000, description="Of an API key that says no other; 0 for any."
    )
    key_jobs: int = Field(
        default=1000,
        ge=0,
        description="Queued and running jobs of the owner of an API key that says no other; 0 for "
        "any number.",
    )
    key_stored_bytes: int = Field(
        default=100 * GIBIBYTE,
        ge=0,
        description="Bytes that the owner of an API key that says no other may store; 0 for any.",
    )
    key_streams: int = Field(
        default=32,
        ge=0,
        description="Streams of events that an API key that says no other may have open at a time "
        "in each API process; 0 for any number.",
    )
    metrics_token: str | None = Field(
        default=None,
        min_length=16,
        repr=False,
        description="Bearer token for /metrics; without one it is open where the API is, and "
        "closed where keys are needed.",
    )
    cors_origins: str = Field(
        default="",
        pattern=r"^(https?://[^\s,/]+(\s*,\s*https?://[^\s,/]+)*)?$",
        description="Origins whose pages may use the API, with commas, as https://a.example.org.",
    )

    drain_seconds: int = Field(
        default=20,
        ge=0,
        description="Time that a stopping API leaves uploads and downloads under way; whoever only "
        "waits for a job is answered at once.",
    )
    event_heartbeat_seconds: float = Field(
        default=15,
        gt=0,
        description="Time between signs of life in a stream of events; less than the idle limit of "
        "proxies.",
    )

    public_url: str | None = Field(
        default=None,
        pattern=r"^https?://[^\s?#]+[^\s?#/]$",
        description="Address at which clients reach the API, for links in webhooks; without it "
        "they are paths.",
    )
    webhook_secret: str = Field(
        default="",
        repr=False,
        description="Keys that sign webhooks, as whsec_ and base64 of 24 to 64 bytes; several with "
        "spaces while a key is changed, the new one first. Without one there are no webhooks.",
    )
    webhook_http: bool = Field(
        default=False, description="Whether webhooks may go to http:// addresses, unencrypted."
    )
    webhook_allow: str = Field(
        default="",
        description="Networks, with commas, that webhooks may go to although they are not public, "
        "as 10.1.0.0/16.",
    )
    webhook_timeout_seconds: float = Field(
        default=15, gt=0, le=120, description="Longest time of one attempt to deliver a webhook."
    )
    webhook_pauses: Annotated[tuple[Annotated[float, Field(gt=0, le=7 * DAY)], ...], NoDecode] = (
        Field(
            default=(5, 300, 1800, 7200, 18000, 36000, 36000),
            description="Seconds between the attempts to deliver a webhook, as a JSON list; it is "
            "given up after the last one.",
        )
    )

    log_level: Literal["DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL"] = "INFO"

    @field_validator("metrics_token", "public_url", "storage_url", mode="before")
    @classmethod
    def _none_when_empty(cls, given: object) -> object:
        return given or None  # how files of containers leave something unset

    @field_validator("redis_url")
    @classmethod
    def _redis_that_can_be_asked(cls, url: str | None) -> str | None:
        if url is not None and not _names_redis(url):
            # Nothing of the address is told: it may have a password.
            raise PydanticCustomError(
                "redis_url",
                "it must be the address of a Redis server, as redis://host:6379/0, "
                "rediss://host:6379/0 or unix:///folder/redis.sock",
            )
        return url

    @field_validator("storage_url")
    @classmethod
    def _folder_or_bucket(cls, url: str | None) -> str | None:
        parts = urlsplit(url or "file:///")
        folder = parts.netloc in ("", "localhost") and parts.path.startswith("/")
        if not {"file": folder, "s3": bool(parts.netloc)}.get(parts.scheme, False):
            raise PydanticCustomError(
                "storage_url", "it must be file:///folder or s3://bucket/prefix"
            )
        return url

    @field_validator("webhook_pauses", mode="before")
    @classmethod
    def _list_of_text(cls, given: object) -> object:
        if not isinstance(given, str):
            return given
        try:
            return json.loads(given)
        except ValueError:
            raise PydanticCustomError(
                "webhook_pauses", "it must be a JSON list of seconds, as [5, 300, 1800]"
            ) from None

    @field_validator("webhook_secret")
    @classmethod
    def _whole_keys(cls, keys: str) -> str:
        for key in keys.split():
            try:
                decoded = base64.b64decode(key.removeprefix("whsec_"), validate=True)
            except ValueError:
                decoded = b""
            if not key.startswith("whsec_") or not 24 <= len(decoded) <= 64:
                # The key itself is not told: the message ends up in logs.
                raise PydanticCustomError(
                    "webhook_secret", "each key is whsec_ and the base64 of 24 to 64 bytes"
                )
        return keys

    @field_validator("webhook_allow")
    @classmethod
    def _networks(cls, networks: str) -> str:
        for network in networks.replace(",", " ").split():
            try:
                ipaddress.ip_network(network)
            except ValueError as error:
                raise ValueError(f"{error}; networks are written as 10.1.0.0/16") from None
        return networks

    @property
    def webhook_networks(self) -> tuple[ipaddress.IPv4Network | ipaddress.IPv6Network, ...]:
        """Networks that webhooks may go to although they are not public."""
        return tuple(map(ipaddress.ip_network, self.webhook_allow.replace(",", " ").split()))

    @property
    def objects_url(self) -> str:
        """Address of the object storage that is in force."""
        return self.storage_url or (self.data_dir / "objects").resolve().as_uri()

    @property
    def scratch(self) -> Path:
        """Scratch folder that is in force."""
        return (self.scratch_dir or self.data_dir / "scratch").resolve()

    @property
    def threads_per_worker(self) -> int:
        """Number of BLAS threads of one worker."""
        return self.threads or max(1, available_cores() // self.workers)

    @property
    def longest_ttl(self) -> float:
        """Longest time to live in seconds that a job may ask for; infinite for no limit."""
        if not (self.max_ttl_seconds and self.result_ttl_seconds):
            return math.inf
        return max(self.max_ttl_seconds, self.result_ttl_seconds)

    def time_limit(self, asked: float | None) -> float:
        """Return the seconds that a job may run which asked for some, or for nothing."""
        return min(asked or self.job_timeout_seconds, self.job_timeout_seconds)

    @property
    def memory_per_job(self) -> int | None:
        """Bytes that a job may take, or None where nothing limits it."""
        if self.job_memory_bytes is not None:
            return self.job_memory_bytes
        limit = memory_limit()
        return None if limit is None else max(limit // self.workers - _WORKER_BYTES, _LEAST_BYTES)

    def to_environ(self) -> dict[str, str]:
        """Return environment variables that give a subprocess the same settings."""
        values = self.model_dump(mode="json") | {"data_dir": self.data_dir.resolve()}
        return {
            f"SMSR_{name.upper()}": str(value)
            for name, value in values.items()
            if value is not None
        }


def read_settings(**given: Any) -> Settings:
    """Return the settings of the environment.

    Parameters
    ----------
    **given
        Settings that go before those of the environment.

    Raises
    ------
    WrongSettings
        Some of them cannot be.
    """
    try:
        return Settings(**given)
    except ValidationError as error:
        found = error.errors(include_url=False, include_input=False)
        raise WrongSettings([_line(problem) for problem in found]) from None


def _names_redis(url: str) -> bool:
    try:
        options = parse_url(url)  # type: ignore[no-untyped-call]
    except ValueError:
        return False
    return not url.startswith("unix:") or "path" in options


def _line(problem: ErrorDetails) -> str:
    """Return what an operator is told of a setting that cannot be."""
    name, *place = map(str, problem["loc"])
    what = problem["msg"].removeprefix("Value error, ")
    if problem["type"] == "string_pattern_mismatch":
        what = f"{what}. {Settings.model_fields[name].description}"
    if place:
        what = f"item {int(place[0]) + 1}: {what}"
    return f"{_variable(name)}: {what.rstrip('.')}."


def _variable(name: str) -> str:
    # Of a setting's two names pydantic tells the first, whichever was given.
    if name == "SMSR_REDIS_URL" and name not in os.environ:
        return "REDIS_URL"
    return name if name.isupper() else f"SMSR_{name.upper()}"


@functools.cache
def environment_settings() -> Settings:
    """Return the settings of the environment, read once: work-horses inherit them with the fork."""
    return Settings()
