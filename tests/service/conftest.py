"""The program, run inside the test's process."""

import json
import os
import sys
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from typer.main import get_command

from service.cli.main import main, program
from service.cli.progress import ProgressBar
from stage.results.depth_maps import DepthMaps
from stage.results.maps import SurfaceMaps
from tests.scenes.surfaces import make_ball
from tests.service.postgres import binaries, postgres
from tests.service.recording import Recording

SAMPLES = Path(__file__).resolve().parents[2] / "samples"


class Outcome(NamedTuple):
    """What a run of the program came to."""

    code: int
    out: str
    err: str

    def well(self) -> str:
        """Return what a run printed that succeeded and had nothing to say on the standard error."""
        assert (self.code, self.err) == (0, ""), self
        return self.out

    def refused(self, words: str, *, printed: bool = False) -> str:
        """Return the one sentence, with these words, of a run that was refused; unless it has printed something, it said nothing else."""
        assert self.code == 2 and printed == bool(self.out) and self.err.startswith("relit: ") and self.err.count("\n") == 1, self
        assert words in self.err, self
        return self.err


class Made(NamedTuple):
    """What a solve or a depth has made and said."""

    maps: Any  # SurfaceMaps or DepthMaps
    report: dict[str, Any]
    said: str


@cache
def made_program(wanted: str | None = None) -> Any:
    """Return the program of a command, or all of it, as it is run, made once: to make it takes longer than many runs."""
    return get_command(program(wanted))


class Program:
    """Runs `relit ARGS`; what C libraries write on the terminal is caught too.

    Every run that succeeds is held to its progress: each stage comes to its total. Only what a service does is seen now and then.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch, self._capfd = monkeypatch, capfd

    def __call__(self, *arguments: object) -> Outcome:
        recording = Recording()
        self._monkeypatch.setattr(ProgressBar, "stage", lambda _, name, total: recording.stage(name, total))
        self._monkeypatch.setattr(ProgressBar, "advance", lambda _, done: recording.advance(done))
        self._monkeypatch.setattr(sys, "argv", ["relit", *map(str, arguments)])
        self._monkeypatch.setattr("service.cli.main.program", made_program)
        self._capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = self._capfd.readouterr()
        assert ended.value.code or arguments[0] in ("submit", "jobs") or not recording.faults
        return Outcome(int(ended.value.code or 0), out, err)

    def done(self, *arguments: object) -> Outcome:
        """Run what has to succeed without a word of complaint."""
        outcome = self(*arguments)
        outcome.well()
        return outcome

    def solve(self, capture: Path, *options: object, **more: Any) -> Made:
        """Run `relit solve`; the other arguments are those of `depth`."""
        return self._made("solve", capture, options, lambda out, unsure: SurfaceMaps.read(out / "maps.exr", unsure=unsure), **more)

    def depth(self, capture: Path, *options: object, **more: Any) -> Made:
        """Run `relit depth` and read its results.

        `out`: where they are; None: in the folder `out` of the capture. `code`: how it is to end; None: well, whether or not a pixel is
        sure. `unsure`: pixels that are not sure keep their values.
        """
        return self._made("depth", capture, options, lambda out, unsure: DepthMaps.read(out / "depth.exr", unsure=unsure), **more)

    def _made(self, command: str, capture: Path, options: tuple[object, ...], read: Any, *, out: Path | None = None, code: int | None = 0,
              unsure: bool = False) -> Made:
        out = out or capture / "out"
        outcome = self(command, capture, "--out", out, *options)
        assert outcome.err == "" and outcome.code in ((0, 1) if code is None else (code,)), outcome
        return Made(read(out, unsure), json.loads((out / "report.json").read_text()), outcome.out)

    def refused(self, *arguments: object) -> str:
        """Return the one sentence that refuses the user's input."""
        outcome = self(*arguments)
        return outcome.refused("", printed=bool(outcome.out))


@pytest.fixture
def relit(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Program:
    """The program."""
    return Program(monkeypatch, capfd)


@pytest.fixture(scope="session")
def server_postgres():
    """A PostgreSQL server."""
    programs = binaries()
    if programs is None:
        pytest.skip("no PostgreSQL server programs: neither on the PATH nor in /usr/lib/postgresql")
    with postgres(programs) as server:
        yield server


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory):
    """A server without keys and with a worker, which the tests of the API and those of the client share."""
    from tests.service.server_process import serving

    folder = tmp_path_factory.mktemp("server")
    with serving(folder, "--anonymous", "--device", "cpu", sabotage="long", hook_networks="127.0.0.0/8",
                 roots=os.pathsep.join([str(SAMPLES), str(folder / "registered")])) as running:
        yield running


@pytest.fixture
def ball() -> SurfaceMaps:
    """A hemisphere with every layer."""
    return make_ball()
