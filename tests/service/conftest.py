"""The program, run inside the test's process."""

import sys
from collections.abc import Callable
from typing import NamedTuple

import pytest

from service.cli.main import main
from tests.service.postgres import binaries, postgres


class Outcome(NamedTuple):
    """What a run of the program came to."""

    code: int
    out: str
    err: str


@pytest.fixture
def relit(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """Run `relit ARGS`; what C libraries write on the terminal is caught too."""

    def run(*arguments: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["relit", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capfd.readouterr()
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
