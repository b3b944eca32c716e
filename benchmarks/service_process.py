"""A service for benchmarks: `relit serve` with one worker on the CPU, a key, and the samples as a root."""

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

SAMPLES = Path(__file__).resolve().parents[1] / "samples"
RELIT = (sys.executable, "-m", "service.cli.main")
END_S = 90.0


class Running(NamedTuple):
    """A service that runs."""

    url: str
    key: str
    pid: int
    """Identifier of the process that runs the API."""


@contextmanager
def running(folder: Path, *, descriptors: int | None = None, **settings: str) -> Iterator[Running]:
    """Start a service and end it.

    Args:
        folder: for its data and its log.
        descriptors: files that it may have open at most; None: what the system allows.
        settings: without RELIT_, as text.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data = folder / "data"
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RELIT_")}
    chosen = {"roots": str(SAMPLES), "requests_per_second": "100000", "request_burst": "100000", "max_queued": "100000"} | settings
    environment |= {f"RELIT_{name.upper()}": value for name, value in chosen.items()}
    with open(folder / "log.txt", "w") as log:
        limited = [] if descriptors is None else ["prlimit", f"--nofile={descriptors}:{descriptors}"]
        process = subprocess.Popen([*limited, *RELIT, "serve", "--data", str(data), "--port", "0", "--device", "cpu"],
                                   stdout=subprocess.PIPE, stderr=log, text=True, env=environment)
        try:
            assert process.stdout is not None
            found = re.search(r"http://\S+:\d+", process.stdout.readline())
            if found is None:
                raise RuntimeError(f"the service did not start: {(folder / 'log.txt').read_text()[-2000:]}")
            key = subprocess.run([*RELIT, "keys", "create", "--project", "benchmark", "--name", "benchmark", "--scope", "admin",
                                  "--data", str(data)], check=True, capture_output=True, text=True).stdout.strip()
            yield Running(found[0], key, process.pid)
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
