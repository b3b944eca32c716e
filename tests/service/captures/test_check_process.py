"""Checks in a process of their own: the same answers, no secrets, and an end that concerns nobody else."""

import errno
import json
import math
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from service.captures import check_process
from service.captures.admit import admit_capture, admit_environment
from service.captures.check_process import check_in_process, import_in_process
from service.errors import RequestError
from service.requests.base.import_choices import ImportChoices
from tests.scenes.captures import edit_manifest, make_scene, write_capture, write_image
from tests.service.recording import Recording

SAMPLES = Path(__file__).parents[3] / "samples"
PIXELS = 200_000_000
FACTS = "print(json.dumps({'facts': %s}))"


class Told(Recording):
    """A progress that stops after some seconds."""

    def __init__(self, stop_after_s: float = math.inf) -> None:
        super().__init__()
        self._stop_at = time.monotonic() + stop_after_s

    def advance(self, done: int) -> None:
        if time.monotonic() > self._stop_at:
            raise InterruptedError


def check(folder: Path, *, environment: bool = False, root: Path | None = None, progress: Told | None = None) -> dict:
    return check_in_process(folder, environment=environment, root=root, max_pixels=PIXELS, progress=progress or Told())


def running(monkeypatch, code: str) -> None:
    """Let other code run in place of the check."""
    monkeypatch.setattr(check_process, "COMMAND", (sys.executable, "-c", f"import json, os, signal, sys, time\n{code}"))


@pytest.mark.long
@pytest.mark.parametrize("registered", [False, True])
def test_it_finds_what_a_check_finds(registered):
    told = Told()
    root = SAMPLES if registered else None
    assert check(SAMPLES / "owl", root=root, progress=told) == admit_capture(SAMPLES / "owl", max_pixels=PIXELS)
    assert [stage[:2] for stage in told.stages] == [("check", 1)]
    sky = SAMPLES / "owl" / "environment.exr"
    assert check(sky, environment=True, root=root) == admit_environment(sky, max_pixels=PIXELS)


@pytest.mark.parametrize(("changes", "faults"), [
    ({"mask": 3, "saturation": 0}, ["capture.json: mask: is 3: ", "capture.json: saturation: is 0: "]),
    ({"mask": "nothing.png"}, ["capture.json: mask: nothing.png is not in the folder"])])
def test_faults_are_in_one_line_without_the_folder(tmp_path, changes, faults):
    write_capture(tmp_path / "cap", make_scene(size=8, lights=5))
    edit_manifest(tmp_path / "cap", **changes)
    with pytest.raises(RequestError) as error:
        check(tmp_path / "cap")
    for found, words in zip(str(error.value).split("; "), faults, strict=True):
        assert found.startswith(words)


def test_a_link_out_of_a_registered_folder_is_not_followed(tmp_path):
    write_capture(tmp_path / "root" / "cap", make_scene(size=8, lights=5))
    (tmp_path / "root" / "link").symlink_to(tmp_path / "root" / "cap")
    with pytest.raises(RequestError, match="a link leads to it"):
        check(tmp_path / "root" / "link", root=tmp_path / "root")


def test_it_has_no_secrets_and_an_error_of_relit_itself_is_told_with_its_place(monkeypatch):
    """/proc/PID/environ shows what a process was started with, whatever it deletes."""
    monkeypatch.setenv("RELIT_DATABASE_URL", "postgresql://user:secret@host/name")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    running(monkeypatch, FACTS % "dict(os.environ) | {'arguments': sys.argv, 'files': len(os.listdir('/proc/self/fd'))}")
    found = check(SAMPLES / "owl")
    assert "secret" not in json.dumps(found)
    assert found["files"] <= 4  # its input, output and errors, and the folder that is listed
    running(monkeypatch, "print(json.dumps({'fault': 'Traceback: line 7'}))")
    with pytest.raises(RuntimeError, match="line 7"):
        check(SAMPLES / "owl")


@pytest.mark.parametrize(("code", "words"), [
    ("os.kill(os.getpid(), signal.SIGSEGV)", rf"broke off \(exit code -{int(signal.SIGSEGV)}\): one of them is damaged"),
    ("sys.exit(7)", r"broke off \(exit code 7\)"),
    ("os.kill(os.getpid(), signal.SIGKILL)", "more than 300 seconds of processor time or 2 GiB of memory"),
    ("os.kill(os.getpid(), signal.SIGXCPU)", "more than 300 seconds of processor time"),
    pytest.param("print('x' * (3 << 20))", "broke off", marks=pytest.mark.long),
])
def test_a_process_that_ends_is_a_sentence(monkeypatch, code, words):
    running(monkeypatch, code)
    with pytest.raises(RequestError, match=words):
        check(SAMPLES / "owl")


def test_its_memory_and_its_files_are_bounded(monkeypatch, tmp_path):
    running(monkeypatch, f"""
sys.path.insert(0, {str(Path(__file__).parents[3])!r})
from service.captures import check_process
check_process.limit(DATA=check_process.MEMORY_BYTES, FSIZE=check_process.FILE_BYTES)
found = []
for size in (1 << 30, 2 << 30):
    try:
        found.append(len(bytes(size)))
    except MemoryError:
        found.append(None)
try:
    open({str(tmp_path / "file")!r}, "wb", buffering=0).write(bytes(1 << 16))
    open({str(tmp_path / "file")!r}, "ab", buffering=0).write(b"x")
    found.append("written")
except OSError as error:
    found.append(error.errno)
print(json.dumps({{"facts": {{"found": found}}}}))""")
    assert check(SAMPLES / "owl")["found"] == [1 << 30, None, errno.EFBIG]


def test_a_process_that_takes_too_long_or_is_not_wanted_is_ended(monkeypatch, tmp_path):
    running(monkeypatch, f"open({str(tmp_path / 'pid')!r}, 'w').write(str(os.getpid())); time.sleep(600)")
    with pytest.raises(InterruptedError):
        check(SAMPLES / "owl", progress=Told(stop_after_s=0.5))
    monkeypatch.setattr(check_process, "WALL_S", 1.0)
    with pytest.raises(RequestError, match="was ended after 1 seconds"):
        check(SAMPLES / "owl")
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


def test_what_a_library_prints_is_no_answer(tmp_path):
    """The decoders of damaged files print on the standard output."""
    write_capture(tmp_path / "cap", make_scene(size=8, lights=5))
    noise = f"import os, sys; sys.path[:0] = {sys.path!r}\nfrom stage.formats import images\nbefore = images.read_header"
    code = f"""{noise}
def noisy(path):
    os.write(1, b"libtiff: {{}}\\n")
    return before(path)
images.read_header = noisy
from service.captures import check_process
check_process.main()"""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(check_process, "COMMAND", (sys.executable, "-c", code))
        assert check(tmp_path / "cap")["frames"] == 5


@pytest.mark.parametrize(("name", "layout", "content"), [
    ("dome.lp", "lp", "1\n../outside.png 0 0 1\n"),
    ("dome.relight", "relightlab", json.dumps({"folder": "nothing", "images": [
        {"filename": "../outside.png", "direction": {"x": 0, "y": 0, "z": 1}}]}))])
def test_an_import_does_not_tell_which_files_there_are_elsewhere(tmp_path, name, layout, content):
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / name).write_text(content)

    def fault() -> str:
        with pytest.raises(RequestError) as error:
            import_in_process(folder, ImportChoices(layout=layout, file=name), (), "dome", max_pixels=PIXELS, progress=Told())
        return str(error.value)

    missing = fault()
    write_image(tmp_path / "outside.png", np.zeros((4, 5, 3), np.uint16))
    assert fault() == missing
