"""Images are read while the solver is imported: the same maps, the same sentences, and nothing left of a reader that was stopped.

Every program here is a process of its own, because one with threads, like that of the tests, reads nothing ahead.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import service
from stage.capture import Capture
from stage.ingest import CACHE_FOLDER, Ingest
from tests.scenes.captures import write_capture

ROOT = Path(service.__file__).parents[1]
AHEAD = """
import os, sys, time
from pathlib import Path
from service.cli.ahead import reading_ahead
from stage import ingest
from stage.capture import Capture

capture = Capture.open(Path(sys.argv[1]))
while len(os.listdir("/proc/self/task")) > 1:  # on a loaded machine threads that have ended are there for a while
    time.sleep(0.01)
"""
PLAINLY = """
with reading_ahead(capture, None):
    pass
"""
BESIDE_A_THREAD = """
import threading
threading.Thread(target=threading.Event().wait, daemon=True).start()
"""
INTERRUPTED = """
import signal
signal.signal(signal.SIGTERM, signal.default_int_handler)  # as the program does
begun, decode = Path(sys.argv[2]), ingest.half_planes
def slow(radiance):
    begun.touch()
    time.sleep(0.5)
    return decode(radiance)
ingest.half_planes = slow
try:
    with reading_ahead(capture, None):
        for _ in range(3000):  # half a minute
            if begun.exists():
                break
            time.sleep(0.01)
        raise KeyboardInterrupt
except KeyboardInterrupt:
    print("stopped")
"""


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}  # as the program has it
    return subprocess.run([sys.executable, *map(str, arguments)], cwd=ROOT, env=environment, capture_output=True, text=True)


@pytest.fixture
def capture(tmp_path) -> Path:
    return write_capture(tmp_path / "capture")


def test_the_stack_is_there_when_the_context_ends(capture):
    done = run("-c", AHEAD + PLAINLY, capture)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    key = Ingest.of(Capture.open(capture)).key
    assert (capture / CACHE_FOLDER / f"stack-{key}.json").exists()


def test_nothing_is_read_ahead_where_a_thread_runs(capture):
    """A process that is forked has none of the threads that may hold a lock."""
    done = run("-c", AHEAD + BESIDE_A_THREAD + PLAINLY, capture)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert not (capture / CACHE_FOLDER).exists()


def test_solved_maps_are_those_of_a_program_that_reads_nothing_ahead(relit, capture, tmp_path):
    arguments = ["solve", capture, "--method", "lambert", "--device", "cpu"]
    done = run("-m", "service.cli.main", *arguments, "--out", tmp_path / "ahead")
    outcome = relit(*arguments, "--cache", tmp_path / "cache", "--out", tmp_path / "plain")
    assert (done.returncode, outcome.code, done.stderr, outcome.err) == (0, 0, "", "")
    assert done.stdout.replace("ahead", "plain") == outcome.out
    ahead, plain = (tmp_path / name / "maps.exr" for name in ("ahead", "plain"))
    assert ahead.read_bytes() == plain.read_bytes()


def test_a_broken_image_is_one_sentence(capture, tmp_path):
    image = next(capture.glob("*.exr"))
    image.write_bytes(image.read_bytes()[:100])
    done = run("-m", "service.cli.main", "solve", capture, "--out", tmp_path / "out", "--device", "cpu")
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert image.name in done.stderr
    assert not any(path for path in (capture / CACHE_FOLDER).glob("*") if "stack" in path.name)


def test_an_interrupted_reader_leaves_nothing(capture, tmp_path):
    done = run("-c", AHEAD + INTERRUPTED, capture, tmp_path / "begun")
    assert (done.returncode, done.stdout, done.stderr) == (0, "stopped\n", "")
    assert not any((capture / CACHE_FOLDER).iterdir())
