"""Memory that threads have freed: that the service starts without a cache for each thread, in the same process, and nothing else does."""

import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

import pytest

from service.server import malloc
from service.server.malloc import NO_THREAD_CACHES, RESTARTED, THREAD_CACHE, TUNABLES, restart_without_thread_caches
from tests.service.server_process import serving

BLOCKS, BYTES = 7, 600
"""As many blocks of one size as glibc keeps for a thread by default."""
PROGRAM = f"""
import ctypes, json, os, subprocess, sys
from service.server.malloc import restart_without_thread_caches

class Mallinfo2(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in
                "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()]

if sys.argv[1] == "restarts":
    restart_without_thread_caches()
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
libc.mallinfo2.restype = Mallinfo2
blocks = [libc.malloc({BYTES}) for _ in range({BLOCKS})]
used = libc.mallinfo2().uordblks
for block in blocks:
    libc.free(block)
freed = used - libc.mallinfo2().uordblks
child = sys.argv[1] == "restarts" and json.loads(subprocess.run([sys.executable, "-c", sys.orig_argv[2], "child"],
                                                                capture_output=True, check=True).stdout)
print(json.dumps({{"freed": freed, "process": os.getpid(), "arguments": sys.argv, "child": child,
                  "variables": {{name: os.environ.get(name) for name in ("{TUNABLES}", "{RESTARTED}")}}}}))
"""

glibc = pytest.mark.skipif(tuple(map(int, platform.libc_ver()[1].split("."))) < (2, 33) if platform.libc_ver()[0] == "glibc" else True,
                           reason="only glibc has these caches, and from 2.33 on says how much is in use")


def run(tunables: str | None) -> tuple[int, dict]:
    """What the program found, and the process that was started for it."""
    environment = {name: value for name, value in os.environ.items() if name != TUNABLES}
    if tunables is not None:
        environment[TUNABLES] = tunables
    with subprocess.Popen([sys.executable, "-c", PROGRAM, "restarts", "a b", ""], stdout=subprocess.PIPE, text=True,
                          env=environment) as process:
        out, _ = process.communicate(timeout=60)
    assert process.returncode == 0
    return process.pid, json.loads(out)


@glibc
@pytest.mark.parametrize("given", [None, "glibc.malloc.arena_max=3"])
def test_what_a_thread_frees_is_free_for_all(given):
    process, found = run(given)
    assert found["freed"] >= BLOCKS * BYTES
    assert found["process"] == process and found["arguments"] == ["-c", "restarts", "a b", ""]


@glibc
@pytest.mark.parametrize("given", [None, "glibc.malloc.arena_max=3"])
def test_programs_that_it_starts_have_the_caches(given):
    _, found = run(given)
    assert found["variables"] == found["child"]["variables"] == {TUNABLES: given, RESTARTED: None}
    assert found["child"]["freed"] < BLOCKS * BYTES


@glibc
def test_the_number_of_blocks_that_the_operator_sets_stays():
    given = f"{THREAD_CACHE}=3"
    _, found = run(given)
    assert (BLOCKS - 3) * BYTES <= found["freed"] < BLOCKS * BYTES
    assert found["variables"] == {TUNABLES: given, RESTARTED: None}


@glibc
def test_the_api_has_no_thread_caches_and_its_worker_has(tmp_path, monkeypatch):
    monkeypatch.delenv(TUNABLES, raising=False)
    with serving(tmp_path, "--device", "cpu") as server:
        assert NO_THREAD_CACHES.encode() in _variables(server.process.pid)[TUNABLES.encode()]
        deadline = time.monotonic() + 60
        while not (children := _children(server.process.pid)) or any(TUNABLES.encode() in _variables(child) for child in children):
            assert time.monotonic() < deadline, server.log.read_text()  # a child has the environment of its parent until its program starts
            time.sleep(0.05)


def _variables(process: int) -> dict[bytes, bytes]:
    """What a process had in its environment when its program started."""
    pairs = [pair.partition(b"=") for pair in Path(f"/proc/{process}/environ").read_bytes().split(b"\0")]
    return {name: value for name, _, value in pairs}


def _children(process: int) -> list[int]:
    return [int(child) for tasks in Path(f"/proc/{process}/task").glob("*/children") for child in tasks.read_text().split()]


@pytest.fixture
def started(monkeypatch) -> list[list[str]]:
    """Programs that this process would have become, as its command line is that of `relit serve`."""
    became: list[list[str]] = []
    monkeypatch.setattr(malloc.os, "execve", lambda _, arguments, environment: became.append(arguments))
    monkeypatch.setattr(sys, "orig_argv", ["python", "-m", "service.cli.main", "serve"])
    monkeypatch.setattr(sys, "argv", ["main.py", "serve"])
    monkeypatch.delenv(TUNABLES, raising=False)
    monkeypatch.delenv(RESTARTED, raising=False)
    return became


@glibc
def test_a_program_starts_again_once_though_the_system_takes_the_variable_away(monkeypatch, started):
    restart_without_thread_caches()
    assert started == [[sys.executable, "-m", "service.cli.main", "serve"]]
    monkeypatch.setenv(RESTARTED, str(os.getpid()))
    restart_without_thread_caches()
    assert len(started) == 1 and TUNABLES not in os.environ and RESTARTED not in os.environ


@glibc
def test_a_process_that_has_inherited_the_variables_starts_again(monkeypatch, started):
    monkeypatch.setenv(RESTARTED, str(os.getppid()))
    restart_without_thread_caches()
    assert len(started) == 1


def test_a_command_that_another_program_calls_does_not_restart_it(monkeypatch, started):
    monkeypatch.setattr(sys, "argv", ["relit", "serve", "--port", "0"])
    restart_without_thread_caches()
    assert started == []


@glibc
def test_a_system_that_starts_no_program_from_this_one_keeps_it(monkeypatch, started):
    def refuse(*_) -> None:
        raise PermissionError("Operation not permitted")

    monkeypatch.setattr(malloc.os, "execve", refuse)
    restart_without_thread_caches()
    assert TUNABLES not in os.environ


def test_another_c_library_is_left_alone(monkeypatch, started):
    def unknown(_: str) -> str:
        raise ValueError("unrecognized configuration name")

    for confstr in (unknown, lambda _: None, lambda _: "NPTL 2.36"):
        monkeypatch.setattr(malloc.os, "confstr", confstr)
        restart_without_thread_caches()
    assert started == []
