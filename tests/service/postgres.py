"""A private PostgreSQL server for tests: a new cluster in a temporary folder, on a free port of the loopback address."""

import os
import pwd
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.service.waiting import free_port

START_S = 60.0
NAME = "relit"
ORDINARY_USERS = ("postgres", "nobody")
"""Of these one runs the server where we are root, which it refuses."""


def binaries() -> Path | None:
    """Folder of the newest server programs of this machine; None: there are none."""
    if (found := shutil.which("initdb")) is not None and (Path(found).resolve().parent / "postgres").is_file():
        return Path(found).resolve().parent
    versions = [path.parent for path in Path("/usr/lib/postgresql").glob("*/bin/initdb")]
    return max(versions, key=lambda path: float(path.parent.name), default=None)


class Postgres:
    """A server that can be restarted."""

    def __init__(self, programs: Path, folder: Path, port: int) -> None:
        self._programs, self._folder, self._port = programs, folder, port
        self._databases = 0
        self._user = None if os.geteuid() != 0 else next(user.pw_name for user in pwd.getpwall() if user.pw_name in ORDINARY_USERS)

    def new_database(self, template: str = "template1") -> str:
        """The URL of a database that is empty, or a copy of one that nobody is connected to."""
        self._databases += 1
        name = f"{NAME}{self._databases}"
        self._do("createdb", "-h", "127.0.0.1", "-p", str(self._port), "-U", NAME, "-T", template, name)
        return f"postgresql://{NAME}@127.0.0.1:{self._port}/{name}"

    def create(self) -> None:
        if self._user is not None:
            shutil.chown(self._folder, self._user)
        self._do("initdb", "-D", str(self._data), "-A", "trust", "-U", NAME, "--no-sync", "-E", "UTF8", "--locale=C")
        self.start()

    def start(self) -> None:
        # the machine does not lose power in a test, so that nothing need reach the disk
        options = f"-k {self._folder} -p {self._port} -c listen_addresses=127.0.0.1 -c fsync=off"
        self._do("pg_ctl", "-D", str(self._data), "-o", options, "-l", str(self._folder / "log.txt"), "-t", f"{START_S:.0f}", "-w", "start")

    def stop(self, mode: str = "fast") -> None:
        """End it: fast breaks off what is going on, immediate leaves a recovery to the next start."""
        self._do("pg_ctl", "-D", str(self._data), "-m", mode, "-w", "stop")

    def restart(self, mode: str, *, away_s: float = 0.0) -> None:
        self.stop(mode)
        time.sleep(away_s)
        self.start()

    @property
    def _data(self) -> Path:
        return self._folder / "data"

    def _do(self, program: str, *arguments: str) -> None:
        done = subprocess.run([self._programs / program, *arguments], cwd=self._folder, user=self._user, stdin=subprocess.DEVNULL,
                              group=None if self._user is None else pwd.getpwnam(self._user).pw_gid, extra_groups=self._user and [],
                              stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, timeout=2 * START_S)
        assert done.returncode == 0, f"{program}: {done.stderr}"


@contextmanager
def postgres(programs: Path) -> Iterator[Postgres]:
    """A server that runs; it and its folder go at the end. Not below pytest's folders, which the server's user may not enter."""
    folder = Path(tempfile.mkdtemp(prefix="relit-postgres-"))
    server = Postgres(programs, folder, free_port())
    try:
        server.create()
        yield server
    finally:
        try:
            if (folder / "data" / "postmaster.pid").exists():
                server.stop("immediate")
        finally:
            shutil.rmtree(folder, ignore_errors=True)
