from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from worker.settings import Settings, WrongSettings, read_settings


def test_defaults_lie_in_the_data_folder(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, redis_url=None)
    assert settings.objects_url == (tmp_path / "objects").as_uri()
    assert settings.scratch == tmp_path / "scratch"
    assert settings.threads_per_worker >= 1


@pytest.mark.parametrize("variable", ["REDIS_URL", "SMSR_REDIS_URL"])
def test_the_address_of_redis(monkeypatch: pytest.MonkeyPatch, variable: str) -> None:
    monkeypatch.setenv(variable, "redis://host:1234/5")
    assert Settings().redis_url == "redis://host:1234/5"


def test_a_subprocess_sees_the_same_settings(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    given = Settings(
        data_dir=Path("relative"),
        redis_url="unix:///tmp/x.sock",
        storage_url="s3://bucket/prefix",
        lease_seconds=2.5,
        threads=3,
        queue="other",
    )
    environment = given.to_environ()
    monkeypatch.chdir(tmp_path)
    expected = given.model_copy(update={"data_dir": Path(environment["SMSR_DATA_DIR"])})
    assert expected.data_dir.is_absolute()
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert Settings() == expected


def test_a_job_may_ask_for_less_time_only() -> None:
    settings = Settings(job_timeout_seconds=100)
    assert settings.time_limit(None) == 100
    assert settings.time_limit(5) == 5
    assert settings.time_limit(1000) == 100


@pytest.mark.parametrize(
    "wrong", [{"lease_seconds": 0}, {"workers": 0}, {"queue": "a b"}, {"log_level": "loud"}]
)
def test_wrong_settings_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        Settings(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("variable", "value", "right"),
    [
        ("SMSR_WORKERS", "abc", "valid integer"),
        ("SMSR_WORKERS", "0", "greater than or equal to 1"),
        ("SMSR_LOG_LEVEL", "loud", "'DEBUG', 'INFO'"),
        ("SMSR_CORS_ORIGINS", "a.example.org", "https://a.example.org"),
        ("SMSR_WEBHOOK_ALLOW", "10.1.2.3/16", "10.1.0.0/16"),
        ("SMSR_WEBHOOK_PAUSES", "5, 300", "JSON list"),
        ("SMSR_WEBHOOK_PAUSES", "[5, 0]", "item 2: "),
        ("SMSR_METRICS_TOKEN", "short", "at least 16 characters"),
        ("SMSR_WEBHOOK_SECRET", "short", "base64 of 24 to 64 bytes"),
        ("REDIS_URL", "foo://x", "redis://host:6379/0"),
        ("SMSR_REDIS_URL", "localhost:6379", "redis://host:6379/0"),
        ("REDIS_URL", "redis://localhost:port", "redis://host:6379/0"),
        ("REDIS_URL", "", "redis://host:6379/0"),
        ("REDIS_URL", "unix://", "unix:///folder/redis.sock"),
        ("SMSR_STORAGE_URL", "foo", "file:///folder or s3://bucket/prefix"),
        ("SMSR_STORAGE_URL", "file://folder", "file:///folder"),
        ("SMSR_STORAGE_URL", "file:folder", "file:///folder"),
        ("SMSR_STORAGE_URL", "s3:///prefix", "s3://bucket/prefix"),
        ("SMSR_STORAGE_URL", "s3://[", "IPv6"),
    ],
)
def test_what_is_wrong_is_told_with_what_would_be_right(
    monkeypatch: pytest.MonkeyPatch, variable: str, value: str, right: str
) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(WrongSettings) as caught:
        read_settings()
    (problem,) = caught.value.problems
    assert problem.startswith(f"{variable}: ")
    assert right in problem
    assert "\n" not in problem


def test_all_that_is_wrong_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SMSR_WORKERS", "abc")
    monkeypatch.setenv("SMSR_THREADS", "0")
    with pytest.raises(WrongSettings) as caught:
        read_settings()
    assert [line.split(":")[0] for line in caught.value.problems] == [
        "SMSR_WORKERS",
        "SMSR_THREADS",
    ]
    # What is given goes before the environment, which may be wrong there.
    with pytest.raises(WrongSettings, match=r"\ASMSR_THREADS: .*\Z"):
        read_settings(workers=2)


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("SMSR_WEBHOOK_SECRET", "whsec_c2VjcmV0LW9mLXRoZS1jb21wYW55="),
        ("SMSR_METRICS_TOKEN", "word-of-company"),
        ("SMSR_REDIS_URL", "redis://:word-of-company"),
        ("REDIS_URL", "reds://user:word-of-company@host"),
    ],
)
def test_a_secret_that_is_wrong_is_not_told(
    monkeypatch: pytest.MonkeyPatch, variable: str, value: str
) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(ValidationError) as caught:
        Settings()
    with pytest.raises(WrongSettings) as read:
        read_settings()
    for secret in ("c2VjcmV0", "word-of-company"):
        assert secret not in str(caught.value)
        assert secret not in str(read.value)


def test_secrets_are_not_shown_with_the_settings() -> None:
    settings = Settings(
        metrics_token="word-of-the-company",
        webhook_secret=f"whsec_{'c2Vj' * 8}",
        redis_url="redis://:word-of-the-company@host",
    )
    assert "word-of" not in repr(settings)
    assert "c2Vj" not in repr(settings)


@pytest.mark.parametrize("name", ["SMSR_STORAGE_URL", "SMSR_METRICS_TOKEN", "SMSR_PUBLIC_URL"])
def test_an_empty_variable_is_none(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv(name, "")
    settings = Settings()
    assert settings.storage_url is settings.metrics_token is settings.public_url is None
