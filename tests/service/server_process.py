"""A real server process for tests: `relit serve` on a free port, its log in a file."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import httpx2

from service.requests.keys import NewKey, Scope
from service.server.base.settings import Settings
from service.server.database import keys
from service.server.database.engine import Database, connect
from tests.service.waiting import until

FREE = {"min_free_bytes": "0", "requests_per_second": "10000", "request_burst": "10000"}
"""Settings of a server that tests ask often, whatever space the disk has left."""
HERE = Path(__file__).resolve().parent
SABOTAGE = os.pathsep.join([str(HERE / "server" / "jobs" / "sabotage"), str(HERE.parents[1])])
"""PYTHONPATH of processes whose workers do with frames what the variable SABOTAGE says; it has this checkout's `service` too."""


def environment_with(**settings: object) -> dict[str, str]:
    """The environment of this process with these settings of the service alone."""
    others = {name: value for name, value in os.environ.items() if not name.startswith("RELIT_")}
    return others | {f"RELIT_{name.upper()}": str(value) for name, value in settings.items()}


class JsonLog:
    """A log of JSON lines that is still written."""

    def __init__(self, path: Path, mark: bytes = b"") -> None:
        """Take each line for JSON, or those that begin with a mark alone."""
        self._path, self._mark, self._read = path, mark, 0
        self._lines: list[dict[str, Any]] = []

    def lines(self) -> list[dict[str, Any]]:
        """Its lines so far, of which each is parsed once."""
        with open(self._path, "rb") as log:
            log.seek(self._read)
            whole, end, _ = log.read().rpartition(b"\n")
        self._read += len(whole + end)
        self._lines += [json.loads(line) for line in whole.splitlines() if line.startswith(self._mark)]
        return self._lines


def new_key(database: Database, project: str = "larch", scope: Scope = Scope.ADMIN, **more: float) -> str:
    """Make a key."""
    return database.transact(partial(keys.insert, wanted=NewKey(project=project, name="test", scope=scope, **more)))


def revoke(database: Database, key: str) -> bool:
    """Revoke a key, if it is not revoked yet."""
    return database.transact(partial(keys.revoke, identifier=key.partition(".")[0]))


def children_of(pid: int) -> list[int]:
    """Processes that a process, or a thread of it, has started."""
    return [int(child) for task in Path(f"/proc/{pid}/task").iterdir() for child in (task / "children").read_text().split()]


class Server:
    """A server that runs."""

    def __init__(self, process: subprocess.Popen[str], url: str, data: Path, log: Path, settings: dict[str, str]) -> None:
        self.process, self.url, self.data, self.log, self.settings = process, url, data, log, settings
        self.lines = JsonLog(log).lines

    @contextmanager
    def database(self) -> Iterator[Database]:
        """Open its database."""
        made = connect(Settings(data=self.data, database_url=self.settings.get("database_url")).sqlalchemy_url)
        try:
            yield made
        finally:
            made.close()

    def key(self, project: str = "larch", scope: Scope = Scope.ADMIN) -> str:
        """Make a key."""
        with self.database() as database:
            return new_key(database, project, scope)

    def client(self, key: str | None = None) -> httpx2.Client:
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        return httpx2.Client(base_url=self.url, headers=headers, timeout=60)

    def wait(self, client: httpx2.Client, path: str, states: tuple[str, ...], timeout_s: float = 120.0) -> dict:
        """Look at something until its state is one of these."""

        def look() -> dict | None:
            found = client.get(path).raise_for_status().json()
            return found if found["state"] in states else None

        try:
            return until(look, f"{path} is not {states} within {timeout_s:g} s", within_s=timeout_s)
        except AssertionError as error:
            error.add_note(self.log.read_text()[-4000:])
            raise


@contextmanager
def serving(folder: Path, *options: str, descriptors: int | None = None, sabotage: str | None = None, **settings: str) -> Iterator[Server]:
    """Start a server, and kill it at last.

    `settings` beside FREE, without RELIT_ and as text; options of `relit serve` beside --data and --port; files that it may have open at
    most; what its workers do with frames, as jobs/sabotage tells.
    """
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "log.txt"
    environment = environment_with(**FREE | settings)
    if sabotage is not None:
        environment |= {"PYTHONPATH": SABOTAGE, "SABOTAGE": sabotage}
    with open(log, "a") as errors:
        process = subprocess.Popen(
            [*([] if descriptors is None else ["prlimit", f"--nofile={descriptors}:{descriptors}"]),
             sys.executable, "-m", "service.cli.main", "serve", "--data", str(folder / "data"), "--port", "0", *options],
            stdout=subprocess.PIPE, stderr=errors, text=True, env=environment, start_new_session=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.search(r"http://\S+:\d+", line)
        assert found is not None, f"the server did not start: {line!r} {log.read_text()[-4000:]}"
        server = Server(process, found[0], folder / "data", log, settings)

        def answers() -> bool:
            with suppress(httpx2.TransportError):
                return httpx2.get(f"{server.url}/healthz", timeout=5).is_success
            assert process.poll() is None, log.read_text()[-4000:]
            return False

        until(answers, "the server does not answer", every_s=0.05)
        yield server
    finally:
        if "--set" in options:  # it ends the commands that it has started
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(90)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)  # its workers too, which would finish their steps first
        process.wait()
