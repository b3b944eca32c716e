"""Settings of the service: from the environment (RELIT_…), or a TOML file that RELIT_CONFIG or --config names, else the defaults here.

A test compares this list with that of docs/service.md.
"""

import os
import re
import tomllib
from collections.abc import Mapping
from contextlib import suppress
from difflib import get_close_matches
from functools import cached_property
from ipaddress import ip_address, ip_network
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self
from urllib.parse import unquote, urlsplit

from pydantic import AfterValidator, BeforeValidator, Field, model_validator
from pydantic_settings import BaseSettings, InitSettingsSource, NoDecode, PydanticBaseSettingsSource, SettingsConfigDict

from service.errors import RequestError
from service.requests.base.identifiers import DEFAULT_PORT, PROJECT_PATTERN
from service.requests.demo import sample_folder
from service.requests.keys import Scope
from stage.model import Count, Positive

PREFIX = "RELIT_"
CONFIG = "RELIT_CONFIG"
OTHERS = (CONFIG, "RELIT_SERVER", "RELIT_KEY", "RELIT_KERNELS")
"""Variables of the program that are not settings of the service."""
TESTS = "RELIT_TEST_"
NO_WORKER = "none"


def _absolute(path: Path) -> Path:
    return path.expanduser().resolve()


Folder = Annotated[Path, AfterValidator(_absolute)]


class ProjectRoot(NamedTuple):
    """A folder below which one project may register captures and environments."""

    project: str
    folder: Folder


class Grant(NamedTuple):
    """The rights of a token with a value of the claim."""

    value: str
    project: str
    scope: Scope


class ProjectQuota(NamedTuple):
    """A quota of one project in place of that of all."""

    project: str
    quota: str
    limit: int


QUOTAS = ("max_project_bytes", "max_project_captures", "max_project_jobs", "max_project_pixels", "max_project_hooks")


def _reader(pattern: str, form: str) -> BeforeValidator:
    """Return a validator that takes a text apart by the groups of a pattern, where <project> is a project's name; `form` is for errors."""
    whole = re.compile(pattern.replace("<project>", f"({PROJECT_PATTERN.strip('^$')})"))

    def read(given: object) -> object:
        if not isinstance(given, str):
            return given
        if (found := whole.fullmatch(given)) is None:
            raise ValueError(f"is {given}: give {form}")
        return found.groups()

    return BeforeValidator(read)


def _several(mark: str) -> BeforeValidator:
    """Return a validator that takes a text apart at a mark."""
    return BeforeValidator(lambda given: [part.strip() for part in given.split(mark) if part.strip()] if isinstance(given, str) else given)


COMMAS, PATHS = _several(","), _several(os.pathsep)
Quoted = Annotated[ProjectQuota, _reader(rf"<project>:({'|'.join(QUOTAS)})=([0-9]{{1,18}})",
                                         f"PROJECT:QUOTA=NUMBER, with a quota of {', '.join(QUOTAS)}")]
Granted = Annotated[Grant, _reader(rf"(.+)=<project>:({'|'.join(Scope)})", f"VALUE=PROJECT:SCOPE, with a scope of {', '.join(Scope)}")]
ProjectFolder = Annotated[ProjectRoot, _reader("<project>=(.+)", "PROJECT=/folder")]


class Settings(BaseSettings):
    """The settings that an operator may choose; arguments override the environment, which overrides the file that `config` names."""

    model_config = SettingsConfigDict(env_prefix=PREFIX, extra="forbid", frozen=True, env_ignore_empty=True, validate_default=True,
                                      use_attribute_docstrings=True)

    data: Folder = Path("relit-data")
    """Folder of the service: captures, results, uploads, locks, and the database unless `database_url` names another."""
    database_url: str | None = None
    """postgresql://user:password@host/name for several machines; without it SQLite in the data folder."""
    storage_url: str | None = None
    """s3://bucket/prefix (needs the extra `s3`) or file:///folder, for captures and results; without it the data folder."""
    scratch_bytes: Count = 500 * 1024**3
    """Bytes that copies of objects of `storage_url` may take in the data folder of each machine, besides those in use."""
    host: str = "127.0.0.1"
    """Address that the API listens on."""
    port: Annotated[int, Field(ge=0, le=65535)] = DEFAULT_PORT
    """Port that the API listens on; 0 takes a free one."""
    anonymous: bool = False
    """Accept requests without a key, in the project `default`; only on loopback addresses."""
    oidc_issuer: str | None = None
    """https://idp.studio: its OpenID Connect tokens are accepted beside keys (needs the extra `oidc`); without it keys alone."""
    oidc_audience: str = "relit"
    """The audience (`aud`) that a token must have."""
    oidc_claim: str = "groups"
    """Claim of a token whose text or texts `oidc_grants` maps to projects."""
    oidc_grants: Annotated[tuple[Granted, ...], NoDecode, COMMAS] = ()
    """The rights that a value of the claim grants: VALUE=PROJECT:SCOPE, separated by commas."""
    roots: Annotated[tuple[Folder, ...], NoDecode, PATHS] = ()
    """Folders of the server whose captures and environments may be registered without an upload; in the environment separated by `:`."""
    project_roots: Annotated[tuple[ProjectFolder, ...], NoDecode, PATHS] = ()
    """As `roots`, each for one project: PROJECT=/folder; in the environment separated by `:`."""
    devices: Annotated[tuple[str, ...], NoDecode, COMMAS] = ()
    """Devices on which `relit serve` starts a worker, separated by commas; without it every GPU, else the CPU; `none` for no worker."""

    max_upload_bytes: Count = 64 * 1024**3
    """Bytes of one uploaded file at most."""
    max_capture_files: Count = 20_000
    """Files of one capture at most."""
    max_pixels: Count = 200_000_000
    """Pixels of one image at most; its header is read before its pixels."""
    max_frames: Count = 20_000
    """Frames of one relight at most."""
    max_queued: Count = 200
    """Queued jobs of one key at most."""
    max_project_bytes: Count | None = None
    """Bytes of the uploaded files and the results of one project at most; without it no limit but the disk."""
    max_project_captures: Count | None = None
    """Captures and environments of one project at most; without it any number."""
    max_project_jobs: Count | None = None
    """Jobs of one project that have not ended at most; without it any number."""
    max_project_pixels: Count | None = None
    """Pixels of all images of the captures and environments of one project at most; without it any number."""
    max_project_hooks: Count = 16
    """Hooks of one project at most."""
    project_quotas: Annotated[tuple[Quoted, ...], NoDecode, COMMAS] = ()
    """Other quotas for some projects, separated by commas: `larch:max_project_jobs=500`."""
    requests_per_second: Positive = 50.0
    """Requests of one key a second, on average, in each API process; a new capture or environment counts as ten."""
    request_burst: Count = 200
    """Requests of one key that may come at once, in each API process."""
    max_connections: Count | None = None
    """Connections of clients at most; without it 8192, or as many as the open files that the system allows leave room for."""
    max_address_connections: Count | None = None
    """Connections of one address at most; without it half of all."""
    max_requests: Count = 256
    """Requests of one key that may be under way at one time, event streams among them, in each API process."""
    max_streams: Count = 128
    """Event streams of one key at most, in each API process."""
    max_project_streams: Count = 512
    """Event streams of one project at most, in each API process."""
    trusted_proxies: Annotated[tuple[str, ...], NoDecode, COMMAS] = ()
    """Addresses or networks of proxies whose `X-Forwarded-For` is believed, separated by commas; without it that of none."""
    hook_networks: Annotated[tuple[str, ...], NoDecode, COMMAS] = ()
    """Addresses or networks that are not public, to which hooks may send all the same, separated by commas; without it none."""
    min_free_bytes: Annotated[int, Field(ge=0)] = 1024**3
    """Bytes that must be free in the data folder; uploads and jobs are refused when less is left."""

    chunk_frames: Annotated[int, Field(ge=1, le=4096)] = 128
    """Frames of one durable step of a relight."""
    stall_s: Positive = 900.0
    """Seconds without progress in a step after which its worker is killed; the job begins the step again."""
    max_lost: Count = 3
    """Workers that a job may lose without progress before it fails."""
    takeover_s: Positive = 2.0
    """Seconds between two looks of a worker for jobs whose worker died."""
    drain_s: Positive = 60.0
    """Seconds that a worker that is asked to end may take to finish its step before it returns the job to the queue."""

    upload_hours: Positive = 48.0
    """Hours after which an upload that was not continued is deleted."""
    retention_days: Positive | None = None
    """Days after which an ended job and its results are deleted; without it never."""
    audit_days: Positive = 400.0
    """Days after which lines of the audit log are deleted."""
    cache_bytes: Count | None = None
    """Bytes of image stacks that are cached at most, beyond which the longest unused go; without it only those of deleted captures."""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    """Lowest severity that is logged."""
    log_format: Literal["json", "text"] = "json"
    """Format of the lines of the log."""
    otel_endpoint: str | None = None
    """http://collector:4318, to whose /v1/traces traces are sent (needs the extra `otel`); without it none are sent."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.anonymous and not self.loopback:
            raise ValueError(f"anonymous: requests without a key are let in on loopback addresses alone, and host is {self.host}")
        if NO_WORKER in self.devices and len(self.devices) > 1:
            raise ValueError(f"devices: {NO_WORKER} stands alone, and they are {', '.join(self.devices)}")
        for name in ("trusted_proxies", "hook_networks"):
            for network in getattr(self, name):
                try:
                    ip_network(network)
                except ValueError:
                    raise ValueError(f"{name}: {network} is no address and no network such as 10.0.0.0/8") from None
        if self.otel_endpoint is not None and not _is_http(self.otel_endpoint):
            raise ValueError(f"otel_endpoint: {self.otel_endpoint} is no address of the form http://host:4318")
        if self.oidc_issuer is not None and not (_is_http(self.oidc_issuer) and (
                self.oidc_issuer.startswith("https:") or is_loopback(urlsplit(self.oidc_issuer).hostname or ""))):
            raise ValueError(f"oidc_issuer: {self.oidc_issuer} is no https:// address")
        kept = {"data": self.data}
        if self.storage_url is not None and self.storage_url.startswith("file:"):
            kept["storage_url"] = _absolute(Path(unquote(urlsplit(self.storage_url).path)))
        for root in (*self.roots, *(root.folder for root in self.project_roots)):
            for name, folder in kept.items():
                if folder.is_relative_to(root) or root.is_relative_to(folder):
                    raise ValueError(f"roots: {root} and {name} ({folder}) lie one within the other, so that a project could register "
                                     "the captures of another: give folders beside each other")
        return self

    def roots_of(self, project: str) -> tuple[Path, ...]:
        """Return the folders below which a project may register captures and environments, those of /set and the sample among them."""
        return (*self.roots, *(root.folder for root in self.project_roots if root.project == project), self.set_captures, *_sample())

    def quota_of(self, project: str, quota: str) -> int | None:
        """Return the limit of one of QUOTAS for a project; None: there is none."""
        own = [each.limit for each in self.project_quotas if (each.project, each.quota) == (project, quota)]
        return own[-1] if own else getattr(self, quota)

    @cached_property
    def loopback(self) -> bool:
        """True if the API listens to this machine only."""
        return is_loopback(self.host)

    @property
    def set_captures(self) -> Path:
        """Folder of the captures that were taken on the page /set, which belong to all projects."""
        return self.data / "set"

    @property
    def is_sqlite(self) -> bool:
        """True if the database is a file in the data folder."""
        return self.database_url is None

    @property
    def sqlite_file(self) -> Path:
        """Path of the database of SQLite."""
        return self.data / "relit.sqlite"

    @property
    def locks(self) -> Path:
        """Folder of the lock files by which the workers of SQLite are known to be alive."""
        return self.data / "locks"

    @property
    def part_files(self) -> Path:
        """Folder of the bytes of incomplete uploads."""
        return self.data / "uploads"

    @property
    def cache(self) -> Path:
        """Folder of the image stacks that this machine caches."""
        return self.data / "cache"

    @property
    def sqlalchemy_url(self) -> str:
        """URL of the database for SQLAlchemy, with the installed driver."""
        if self.database_url is None:
            return f"sqlite:///{self.sqlite_file}"
        scheme, _, rest = self.database_url.partition("://")
        return f"postgresql+psycopg://{rest}" if scheme in ("postgresql", "postgres") else self.database_url

    @classmethod
    def settings_customise_sources(cls, settings_cls: type[BaseSettings], init_settings: PydanticBaseSettingsSource,
                                   env_settings: PydanticBaseSettingsSource, dotenv_settings: PydanticBaseSettingsSource,
                                   file_secret_settings: PydanticBaseSettingsSource) -> tuple[PydanticBaseSettingsSource, ...]:
        """Return the sources: arguments, the environment, the file."""
        assert isinstance(init_settings, InitSettingsSource)
        file = init_settings.init_kwargs.pop("config", None) or os.environ.get(CONFIG)
        return (init_settings, env_settings, *((InitSettingsSource(settings_cls, _of_file(Path(file))),) if file else ()))


def is_loopback(host: str) -> bool:
    """Return whether a host name or address is one of loopback."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def _is_http(url: str) -> bool:
    try:
        parts = urlsplit(url)
        return parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # a port that is no number, or an address with one bracket
        return False


def unknown_variables(environment: Mapping[str, str]) -> dict[str, str | None]:
    """Return variables that look like settings and are not, each with the most similar setting, if there is one."""
    names = [f"{PREFIX}{name.upper()}" for name in Settings.model_fields]
    return {name: next(iter(get_close_matches(name, names, 1, 0.8)), None) for name in sorted(environment)
            if name.startswith(PREFIX) and not name.startswith(TESTS) and name not in names and name not in OTHERS}


def _of_file(file: Path) -> dict[str, Any]:
    try:
        found = tomllib.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise RequestError(f"settings {file}: cannot be read ({error.strerror})") from None
    except RecursionError:
        raise RequestError(f"settings {file}: is nested too deeply") from None
    except ValueError as error:  # no TOML, or no UTF-8
        raise RequestError(f"settings {file}: is no TOML ({error})") from None
    for name in found:
        if name not in Settings.model_fields:
            near = get_close_matches(name, Settings.model_fields, 1, 0.6)
            raise RequestError(f"settings {file}: there is no setting {name}" + (f": is {near[0]} meant?" if near else ""))
    return found


def _sample() -> tuple[Path, ...]:
    with suppress(RequestError):
        return (sample_folder(),)
    return ()
