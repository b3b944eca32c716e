"""The program, run inside the test's process."""

import sys
from collections.abc import Callable
from typing import NamedTuple

import pytest

from service.cli.main import main
from service.cli.progress import ProgressBar
from stage.results.maps import SurfaceMaps
from tests.scenes.surfaces import make_ball
from tests.service.postgres import binaries, postgres
from tests.service.recording import Recording


class Outcome(NamedTuple):
    """What a run of the program came to."""

    code: int
    out: str
    err: str


@pytest.fixture
def relit(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Run `relit ARGS`; what C libraries write on the terminal is caught too.

    Every run that succeeds is held to its progress: each stage comes to its total. Only what a service does is seen now and then.
    """

    def run(*arguments: object) -> Outcome:
        recording = Recording()
        monkeypatch.setattr(ProgressBar, "stage", lambda _, name, total: recording.stage(name, total))
        monkeypatch.setattr(ProgressBar, "advance", lambda _, done: recording.advance(done))
        monkeypatch.setattr(sys, "argv", ["relit", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capfd.readouterr()
        assert ended.value.code or arguments[0] in ("submit", "jobs") or not recording.faults
        return Outcome(int(ended.value.code or 0), out, err)

    return run


@pytest.fixture(scope="session")
def server_postgres():
    """A PostgreSQL server."""
    programs = binaries()
    if programs is None:
        pytest.skip("no PostgreSQL server programs: neither on the PATH nor in /usr/lib/postgresql")
    with postgres(programs) as server:
        yield server


@pytest.fixture
def ball() -> SurfaceMaps:
    """A hemisphere with every layer."""
    return make_ball()
