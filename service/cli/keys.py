"""Commands that make, list and revoke API keys, for whoever runs the service."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import time
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from redis.exceptions import RedisError
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from service.cli.exits import ExitCode, complain, console, errors
from service.cli.local import AsJson
from worker.connections import connect
from worker.keys import ApiKey, KeyStore
from worker.redis_server import ServerFailed, redis_of_folder
from worker.settings import read_settings

if TYPE_CHECKING:
    from collections.abc import Iterator

DataDir = Annotated[
    Path | None,
    typer.Option(
        file_okay=False,
        show_default=False,
        help="Data folder of smsr serve; REDIS_URL or SMSR_DATA_DIR say it otherwise.",
    ),
]

_UNITS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}
_UNITS |= {f"{unit}i": 1 << (10 * power) for power, unit in enumerate("KMGT", start=1)}

_SECONDS = {"h": 3600, "d": 86400, "w": 7 * 86400}

keys = typer.Typer(no_args_is_help=True, help="Make, list and revoke API keys of this service.")


def _bytes(text: str) -> int:
    """Read a number of bytes such as 500M or 20GiB."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]i?)?B?", text.strip())
    if found is None:
        raise typer.BadParameter(f"{text!r} is no number of bytes such as 500M or 20GiB.")
    return int(float(found[1]) * _UNITS[found[2] or ""])


def _moment(text: str) -> float:
    """Read a moment to come, such as 90d, 12h or 2027-01-31; return it in Unix seconds."""
    if found := re.fullmatch(r"(\d{1,6})([hdw])", text.strip()):
        moment = time.time() + int(found[1]) * _SECONDS[found[2]]
    else:
        try:
            moment = datetime.fromisoformat(text.strip()).timestamp()
        except (ValueError, OverflowError):
            raise typer.BadParameter(
                f"{text!r} is neither a time such as 90d or 12h nor a date such as 2027-01-31."
            ) from None
    if moment <= time.time():
        raise typer.BadParameter(f"{text!r} is over.")
    return moment


@keys.command()
def create(
    owner: Annotated[
        str,
        typer.Argument(
            metavar="OWNER",
            show_default=False,
            help="Account that jobs made with the key belong to; it may have several keys.",
        ),
    ],
    note: Annotated[str, typer.Option(help="What the key is for.", show_default=False)] = "",
    requests: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=100_000,
            metavar="N",
            help="Requests a minute, 0 for any number. [default: SMSR_KEY_REQUESTS_PER_MINUTE]",
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            min=0,
            metavar="N",
            help="Queued and running jobs of the owner, 0 for any number. [default: SMSR_KEY_JOBS]",
        ),
    ] = None,
    storage: Annotated[
        str | None,
        typer.Option(
            metavar="BYTES",
            help="Bytes that the owner may store, as 20GiB; 0 for any number. "
            "[default: SMSR_KEY_STORED_BYTES]",
        ),
    ] = None,
    streams: Annotated[
        int | None,
        typer.Option(
            min=0,
            metavar="N",
            help="Streams of events open at a time in each API process, 0 for any number. "
            "[default: SMSR_KEY_STREAMS]",
        ),
    ] = None,
    expires: Annotated[
        str | None,
        typer.Option(
            metavar="WHEN",
            help="End of its time: 90d, 12h or a date such as 2027-01-31. [default: never]",
        ),
    ] = None,
    data_dir: DataDir = None,
    as_json: AsJson = False,
) -> None:
    """Make a key and print it, this once: only its hash is kept."""
    size = None if storage is None else _bytes(storage)
    end = None if expires is None else _moment(expires)
    with _store(data_dir) as store:
        try:
            made, key = store.create(
                owner,
                note=note,
                requests_per_minute=requests,
                jobs=jobs,
                stored_bytes=size,
                streams=streams,
                expires_at=end,
            )
        except ValueError as error:
            complain(str(error))
            raise typer.Exit(ExitCode.USAGE) from error
    if as_json:
        console.print_json(data=dataclasses.asdict(made) | {"key": key})
        return
    console.print(key, soft_wrap=True)
    errors.print(f"Key {made.id} of {escape(owner)}. Keep it: it cannot be shown again.")


@keys.command("list")
def list_keys(data_dir: DataDir = None, as_json: AsJson = False) -> None:
    """List all keys, oldest first, without their secrets."""
    with _store(data_dir) as store:
        found = store.list()
    if as_json:
        console.print_json(data=[dataclasses.asdict(key) for key in found])
        return
    table = Table(
        "key", "owner", "created", "expires", "requests/min", "jobs", "bytes", "streams", "note",
        header_style="bold", box=None,
    )  # fmt: skip
    for key in found:
        table.add_row(*_row(key))
    wide = Console(file=console.file, width=max(console.width, 200))
    wide.print(table)


@keys.command()
def revoke(
    key_ids: Annotated[
        list[str], typer.Argument(metavar="KEY...", show_default=False, help="As listed.")
    ],
    data_dir: DataDir = None,
) -> None:
    """Revoke keys: the next request with one is refused. Jobs made with it stay."""
    unknown = []
    with _store(data_dir) as store:
        for key_id in key_ids:
            if store.revoke(key_id):
                console.print(f"{key_id} revoked")
            else:
                unknown.append(key_id)
    for key_id in unknown:
        complain(f"There is no key {key_id}.")
    if unknown:
        raise typer.Exit(ExitCode.FAILED)


@contextlib.contextmanager
def _store(data_dir: Path | None) -> Iterator[KeyStore]:
    """Open the keys: in the Redis server of the settings, else in that of the data folder."""
    settings = read_settings()
    with contextlib.ExitStack() as stack:
        url = settings.redis_url
        if url is None or data_dir is not None:
            folder = (data_dir or settings.data_dir) / "redis"
            try:
                url = stack.enter_context(redis_of_folder(folder))
            except ServerFailed as error:
                complain(str(error))
                raise typer.Exit(ExitCode.FAILED) from error
        try:
            yield KeyStore(stack.enter_context(contextlib.closing(connect(url))))
        except RedisError as error:
            complain(f"The Redis server does not answer: {error}")
            raise typer.Exit(ExitCode.SERVER_UNREACHABLE) from error


def _row(key: ApiKey) -> tuple[str, ...]:
    def limit(number: int | None) -> str:
        return "default" if number is None else str(number) if number else "any"

    expires = "never" if key.expires_at is None else _date(key.expires_at)
    if key.expired(time.time()):
        expires = f"[red]{expires}[/]"
    given = (key.requests_per_minute, key.jobs, key.stored_bytes, key.streams)
    numbers = (limit(number) for number in given)
    return (key.id, key.owner, _date(key.created_at), expires, *numbers, escape(key.note))


def _date(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds))
