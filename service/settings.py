"""Settings of the service: by environment (RELIT_…), by a TOML file that RELIT_CONFIG or --config names, else as here.

docs/service.md has the same list for operators, and a test compares the two.
"""

import os
from functools import cached_property
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator
from pydantic_settings import BaseSettings, NoDecode, PydanticBaseSettingsSource, SettingsConfigDict, TomlConfigSettingsSource

Count = Annotated[int, Field(ge=1)]
Seconds = Annotated[float, Field(gt=0, allow_inf_nan=False)]


def _absolute(path: Path) -> Path:
    return path.expanduser().resolve()


Folder = Annotated[Path, AfterValidator(_absolute)]


class Settings(BaseSettings):
    """Everything that an operator may choose."""

    model_config = SettingsConfigDict(env_prefix="RELIT_", extra="forbid", frozen=True, env_ignore_empty=True, validate_default=True)

    data: Folder = Path("relit-data")
    """Folder of the service: captures, results, uploads, locks, and the database unless `database_url` names another."""
    database_url: str | None = None
    """postgresql://user:password@host/name for several machines; without it SQLite in the data folder."""
    storage_url: str | None = None
    """s3://bucket/prefix, or another store that obstore reads, for captures and results; without it the data folder."""
    host: str = "127.0.0.1"
    """Address that the API listens on."""
    port: Annotated[int, Field(ge=0, le=65535)] = 8470
    """Port that the API listens on; 0 takes a free one."""
    anonymous: bool = False
    """Let requests without a key work in the project `default`; on loopback addresses alone."""
    roots: Annotated[tuple[Folder, ...], NoDecode] = ()
    """Folders of the server whose captures and environments may be registered without an upload; in the environment with : between."""
    devices: Annotated[tuple[str, ...], NoDecode] = ()
    """Devices that `relit serve` starts a worker on, with commas between; without it every GPU, else the CPU; `none` for no worker."""

    max_upload_bytes: Count = 64 * 1024**3
    """Of one file."""
    max_capture_files: Count = 20_000
    """Of one capture."""
    max_pixels: Count = 200_000_000
    """Of one image; its header is read before its pixels are."""
    max_frames: Count = 20_000
    """Of one relight."""
    max_queued: Count = 200
    """Jobs of one key that have not begun."""
    requests_per_second: Annotated[float, Field(gt=0)] = 50.0
    """Of one key, on average, in each API process."""
    request_burst: Count = 200
    """Requests of one key that may come at once."""
    min_free_bytes: Annotated[int, Field(ge=0)] = 1024**3
    """Uploads and jobs are refused when the data folder has less space left."""

    chunk_frames: Annotated[int, Field(ge=1, le=4096)] = 128
    """Frames of one durable step of a relight."""
    stall_s: Seconds = 900.0
    """A worker whose step makes no progress for this long is killed; its job begins the step again."""
    max_lost: Count = 3
    """Workers that a job may lose in one step before it fails."""
    takeover_s: Seconds = 2.0
    """How often a worker looks for jobs whose worker died."""
    drain_s: Seconds = 60.0
    """How long a worker that is asked to end may take to finish its step, before it hands the job back."""

    upload_hours: Seconds = 48.0
    """Uploads that nobody has added to for this long are removed."""
    retention_days: Seconds | None = None
    """Jobs and their results are removed this long after they ended; without it never."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Least severity that is logged."""
    log_format: Literal["json", "text"] = "json"
    """How a line of the log is written."""
    otel_endpoint: str | None = None
    """OTLP address that traces are sent to; without it none are (needs the extra `otel`)."""

    @model_validator(mode="before")
    @classmethod
    def _split(cls, given: dict[str, object]) -> dict[str, object]:
        for name, mark in (("roots", os.pathsep), ("devices", ",")):
            if isinstance(value := given.get(name), str):
                given[name] = tuple(part.strip() for part in value.split(mark) if part.strip())
        return given

    @model_validator(mode="after")
    def _no_open_door(self) -> Self:
        if self.anonymous and not self.loopback:
            raise ValueError(f"anonymous: requests without a key are let in on loopback addresses alone, and host is {self.host}")
        return self

    @cached_property
    def loopback(self) -> bool:
        """Whether the API listens to this machine alone."""
        if self.host == "localhost":
            return True
        try:
            return ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def is_sqlite(self) -> bool:
        """Whether the database is a file in the data folder."""
        return self.database_url is None

    @property
    def sqlalchemy_url(self) -> str:
        """Of the database, with the driver that we install."""
        if self.database_url is None:
            return f"sqlite:///{self.data / 'relit.sqlite'}"
        scheme, _, rest = self.database_url.partition("://")
        return f"postgresql+psycopg://{rest}" if scheme in ("postgresql", "postgres") else self.database_url

    @classmethod
    def settings_customise_sources(cls, settings_cls: type[BaseSettings], init_settings: PydanticBaseSettingsSource,
                                   env_settings: PydanticBaseSettingsSource, dotenv_settings: PydanticBaseSettingsSource,
                                   file_secret_settings: PydanticBaseSettingsSource) -> tuple[PydanticBaseSettingsSource, ...]:
        """Arguments, then the environment, then the file."""
        file = os.environ.get("RELIT_CONFIG")
        return (init_settings, env_settings, *((TomlConfigSettingsSource(settings_cls, file),) if file else ()))
