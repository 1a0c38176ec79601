from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from worker.settings import Settings


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
    ("variable", "value"),
    [
        ("SMSR_WEBHOOK_SECRET", "whsec_c2VjcmV0LW9mLXRoZS1jb21wYW55="),
        ("SMSR_METRICS_TOKEN", "word-of-company"),
    ],
)
def test_a_secret_that_is_wrong_is_not_told(
    monkeypatch: pytest.MonkeyPatch, variable: str, value: str
) -> None:
    monkeypatch.setenv(variable, value)
    with pytest.raises(ValidationError) as caught:
        Settings()
    assert value not in str(caught.value)


def test_secrets_are_not_shown_with_the_settings() -> None:
    settings = Settings(
        metrics_token="word-of-the-company",
        webhook_secret=f"whsec_{'c2Vj' * 8}",
        redis_url="redis://:word-of-the-company@host",
    )
    assert "word-of" not in repr(settings)
    assert "c2Vj" not in repr(settings)
