"""Settings of the service: by environment (RELIT_…), by a TOML file that RELIT_CONFIG or --config names, else as here.

docs/service.md has the same list for operators, and a test compares the two.
"""

import os
import tomllib
from collections.abc import Mapping
from difflib import get_close_matches
from functools import cached_property
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, Literal, Self
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field, model_validator
from pydantic_settings import BaseSettings, InitSettingsSource, NoDecode, PydanticBaseSettingsSource, SettingsConfigDict

from service.errors import RequestError
from service.requests.jobs import DEFAULT_PORT

Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
PREFIX = "RELIT_"
CONFIG = "RELIT_CONFIG"
OTHERS = (CONFIG, "RELIT_SERVER", "RELIT_KEY")
"""Variables of the program that are no settings of the service."""
TESTS = "RELIT_TEST_"
NO_WORKER = "none"


def _absolute(path: Path) -> Path:
    return path.expanduser().resolve()


Folder = Annotated[Path, AfterValidator(_absolute)]


class Settings(BaseSettings):
    """Everything that an operator may choose.

    Settings(config=FILE, name=value, …): what is given goes before the environment, and that before the file.
    """

    model_config = SettingsConfigDict(env_prefix=PREFIX, extra="forbid", frozen=True, env_ignore_empty=True, validate_default=True,
                                      use_attribute_docstrings=True)

    data: Folder = Path("relit-data")
    """Folder of the service: captures, results, uploads, locks, and the database unless `database_url` names another."""
    database_url: str | None = None
    """postgresql://user:password@host/name for several machines; without it SQLite in the data folder."""
    storage_url: str | None = None
    """s3://bucket/prefix (needs the extra `s3`) or file:///folder, for captures and results; without it the data folder."""
    scratch_bytes: Count = 500 * 1024**3
    """What copies of objects of `storage_url` may take in the data folder of each machine, beside those that are in use."""
    host: str = "127.0.0.1"
    """Address that the API listens on."""
    port: Annotated[int, Field(ge=0, le=65535)] = DEFAULT_PORT
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
    requests_per_second: Positive = 50.0
    """Of one key, on average, in each API process."""
    request_burst: Count = 200
    """Requests of one key that may come at once."""
    min_free_bytes: Annotated[int, Field(ge=0)] = 1024**3
    """Uploads and jobs are refused when the data folder has less space left."""

    chunk_frames: Annotated[int, Field(ge=1, le=4096)] = 128
    """Frames of one durable step of a relight."""
    stall_s: Positive = 900.0
    """A worker whose step makes no progress for this long is killed; its job begins the step again."""
    max_lost: Count = 3
    """Workers that a job may lose in one step before it fails."""
    takeover_s: Positive = 2.0
    """How often a worker looks for jobs whose worker died."""
    drain_s: Positive = 60.0
    """How long a worker that is asked to end may take to finish its step, before it hands the job back."""

    upload_hours: Positive = 48.0
    """Uploads that nobody has added to for this long are removed."""
    retention_days: Positive | None = None
    """Jobs and their results are removed this long after they ended; without it never."""
    cache_bytes: Count | None = None
    """Stack caches beyond this are removed, those that no job has read for longest first; without it only those of deleted captures."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Least severity that is logged."""
    log_format: Literal["json", "text"] = "json"
    """How a line of the log is written."""
    otel_endpoint: str | None = None
    """http://collector:4318: traces are sent to its /v1/traces (needs the extra `otel`); without it none are."""

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

    @model_validator(mode="after")
    def _sense(self) -> Self:
        if NO_WORKER in self.devices and len(self.devices) > 1:
            raise ValueError(f"devices: {NO_WORKER} stands alone, and they are {', '.join(self.devices)}")
        if self.otel_endpoint is not None and (urlsplit(self.otel_endpoint).scheme not in ("http", "https")
                                               or not urlsplit(self.otel_endpoint).hostname):
            raise ValueError(f"otel_endpoint: {self.otel_endpoint} is no address of the form http://host:4318")
        return self

    @cached_property
    def loopback(self) -> bool:
        """Whether the API listens to this machine alone."""
        return is_loopback(self.host)

    @property
    def is_sqlite(self) -> bool:
        """Whether the database is a file in the data folder."""
        return self.database_url is None

    @property
    def sqlite_file(self) -> Path:
        """The database, where it is a file."""
        return self.data / "relit.sqlite"

    @property
    def sqlalchemy_url(self) -> str:
        """Of the database, with the driver that we install."""
        if self.database_url is None:
            return f"sqlite:///{self.sqlite_file}"
        scheme, _, rest = self.database_url.partition("://")
        return f"postgresql+psycopg://{rest}" if scheme in ("postgresql", "postgres") else self.database_url

    @classmethod
    def settings_customise_sources(cls, settings_cls: type[BaseSettings], init_settings: PydanticBaseSettingsSource,
                                   env_settings: PydanticBaseSettingsSource, dotenv_settings: PydanticBaseSettingsSource,
                                   file_secret_settings: PydanticBaseSettingsSource) -> tuple[PydanticBaseSettingsSource, ...]:
        """Arguments, then the environment, then the file."""
        assert isinstance(init_settings, InitSettingsSource)
        file = init_settings.init_kwargs.pop("config", None) or os.environ.get(CONFIG)
        return (init_settings, env_settings, *((InitSettingsSource(settings_cls, _of_file(Path(file))),) if file else ()))


def is_loopback(host: str) -> bool:
    """Whether a name or address is this machine's alone."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def unknown_variables(environment: Mapping[str, str]) -> dict[str, str | None]:
    """Variables that look like settings and are none, each with the one that was meant, where one is near."""
    names = [f"{PREFIX}{name.upper()}" for name in Settings.model_fields]
    return {name: next(iter(get_close_matches(name, names, 1, 0.8)), None) for name in sorted(environment)
            if name.startswith(PREFIX) and not name.startswith(TESTS) and name not in names and name not in OTHERS}


def _of_file(file: Path) -> dict[str, Any]:
    try:
        found = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise RequestError(f"settings {file}: cannot be read ({error.strerror})") from None
    except ValueError as error:  # no TOML, or no UTF-8
        raise RequestError(f"settings {file}: is no TOML ({error})") from None
    for name in found:
        if name not in Settings.model_fields:
            near = get_close_matches(name, Settings.model_fields, 1, 0.6)
            raise RequestError(f"settings {file}: there is no setting {name}" + (f": is {near[0]} meant?" if near else ""))
    return found
