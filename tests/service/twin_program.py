"""`relit twin` as a program, for tests that play or capture what it shows."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import service

ROOT = Path(service.__file__).parents[1]


@contextmanager
def twin_running(rig: Path, capture: Path, host: str, *options: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run the twin at a host of the loopback, as long as the block; yield the program and the address of its page."""
    command = [sys.executable, "-m", "service.cli.main", "twin", rig, capture, "--interface", host, "--port", "0", *map(str, options)]
    program = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    try:
        assert program.stdout is not None
        assert program.stdout.readline() == f"twin     listens on {host} for sACN and Art-Net\n"
        yield program, program.stdout.readline().split()[1].removesuffix(":")
    finally:
        program.kill()
        program.wait()
