"""Uploaded captures are admitted by a process of its own, in bounds."""

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
from service.captures.admit import admit_capture, admit_environment, environment_file, recheck_capture
from service.captures.check_process import check_in_process, import_in_process
from service.errors import RequestError
from service.requests.base.import_choices import ImportChoices
from stage.capture.light import PLACEHOLDER
from stage.capture.manifest import read_manifest
from stage.errors import ImageError, ManifestError
from tests.marks import first_short
from tests.scenes.captures import edit_manifest, make_scene, write_capture, write_exr, write_image, write_manifest
from tests.service.recording import Recording

SAMPLES = Path(__file__).parents[3] / "samples"
PIXELS = 200_000_000
FACTS = "print(json.dumps({'facts': %s}))"
SCENE = make_scene(size=16, lights=4)
MOST_PIXELS = 16 * 16
HISTOGRAM = {"schema": "relit.capture/1", "name": "room", "frames": [
    {"image": "00.npy", "tof": {"type": "pulsed", "bin_s": 1e-9, "start_s": 0.0}}],
    "camera": {"projection": "perspective", "resolution": [6, 4], "focal_px": [5, 5]}}


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


@first_short(("changes", "faults"), [
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


@first_short(("name", "layout", "content"), [
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


def test_a_capture_is_described_without_its_pixels(tmp_path):
    write_capture(tmp_path, SCENE)
    recording = Recording()
    assert admit_capture(tmp_path, max_pixels=MOST_PIXELS, progress=recording) == {
        "captures": 1, "frames": 4, "resolution": [16, 16], "color_space": "lin_rec709_scene", "name": "cap", "lit_by": ["light"],
        "calibrated": ["lights"]}
    assert recording.stages == [("check", 1, [1])]
    recheck_capture(tmp_path, max_pixels=MOST_PIXELS)


def test_the_calibrations_of_a_capture_are_told(tmp_path):
    folder = write_capture(tmp_path, SCENE)
    frames = read_manifest(folder / "capture.json").model_dump(mode="json", by_alias=True, exclude_none=True)["frames"]
    matrix = [[1.1, 0, 0], [0, 1, 0], [0, 0, 0.9]]
    edit_manifest(folder, dark=frames[0]["image"], color_matrix=matrix)
    assert admit_capture(tmp_path, max_pixels=MOST_PIXELS)["calibrated"] == ["dark", "lights", "colours"]
    placeholder = PLACEHOLDER.model_dump(mode="json", exclude_none=True)
    edit_manifest(folder, frames=[frame | {"light": placeholder} for frame in frames])
    assert admit_capture(tmp_path, max_pixels=MOST_PIXELS)["calibrated"] == ["dark", "colours"]


def test_a_sequence_is_counted_and_a_manifest_that_is_wrong_is_named(tmp_path):
    for step in ("t0", "t1", "t2"):
        write_capture(tmp_path / step, SCENE)
    recording = Recording()
    found = admit_capture(tmp_path, max_pixels=MOST_PIXELS, progress=recording)
    assert (found["captures"], found["frames"]) == (3, 12) and recording.faults == []
    edit_manifest(tmp_path / "t1", colour="red")
    with pytest.raises(ManifestError, match="colour: is not a known key"):
        admit_capture(tmp_path, max_pixels=MOST_PIXELS)


@pytest.mark.parametrize("check", [admit_capture, recheck_capture])
def test_places_and_sizes_are_refused(check, tmp_path):
    folder = write_capture(tmp_path / "cap", SCENE)
    with pytest.raises(ImageError, match="16x16 is more than 255 pixels"):
        check(folder, max_pixels=MOST_PIXELS - 1)
    write_exr(tmp_path / "secret.exr", SCENE.images[0])
    (folder / "001.exr").unlink()
    (folder / "001.exr").symlink_to(tmp_path / "secret.exr")
    with pytest.raises(ManifestError, match=r"frames\[1\].image: 001\.exr leads out of the capture's"):
        check(folder, max_pixels=MOST_PIXELS)
    (folder / "001.exr").unlink()
    os.mkfifo(folder / "001.exr")  # to open it would wait for ever
    with pytest.raises(ManifestError, match="is no file"):
        check(folder, max_pixels=MOST_PIXELS)
    (folder / "001.exr").unlink()
    write_exr(folder / "001.exr", np.zeros((64, 64, 3)))
    with pytest.raises(ImageError, match=r"001\.exr: has 64x64 pixels, 256 are allowed"):
        check(folder, max_pixels=MOST_PIXELS)


@pytest.mark.parametrize(("array", "words"), [
    (np.ones((4, 6, 8), np.complex64), "is not an array of real numbers"), (np.ones(6), r"has the shape \(6,\)"),
    (np.ones((40, 6)), "has 6x40 pixels, 24 are allowed"), (np.ones((4, 6, 8), np.float32), "it has 764 bytes of 768"),
])
def test_headers_of_arrays(array, words, tmp_path):
    np.save(tmp_path / "00.npy", array)
    write_manifest(tmp_path, HISTOGRAM)
    if "bytes" in words:  # an array that is cut short
        admit_capture(tmp_path, max_pixels=24)
        (tmp_path / "00.npy").write_bytes((tmp_path / "00.npy").read_bytes()[:-4])
    with pytest.raises(ImageError, match=words):
        admit_capture(tmp_path, max_pixels=24)


def test_an_environment_is_one_lat_long_image(tmp_path):
    folder = tmp_path / "sky"
    folder.mkdir()
    with pytest.raises(ImageError, match="has 0 files"):
        admit_environment(folder, max_pixels=1000)
    path = write_exr(folder / "sky.exr", np.ones((8, 16, 3)))
    (folder / ".notes").write_text("")
    assert admit_environment(folder, max_pixels=128) == {"file": "sky.exr", "resolution": [16, 8]}
    assert environment_file(folder) == environment_file(path) == path
    with pytest.raises(ImageError, match="has 16x8 pixels, 100 are allowed"):
        admit_environment(folder, max_pixels=100)
    write_exr(folder / "b.exr", np.ones((8, 16, 3)))
    with pytest.raises(ImageError, match="has 2 files"):
        admit_environment(folder, max_pixels=1000)
    (folder / "b.exr").unlink()
    write_exr(path, np.ones((8, 8, 3)))
    with pytest.raises(ImageError, match="is 8x8: a lat-long map is twice as wide as it is high"):
        admit_environment(folder, max_pixels=1000)
    path.rename(folder / "sky.png")
    with pytest.raises(ImageError, match=r"\.exr or \.hdr"):
        admit_environment(folder, max_pixels=1000)


def test_the_images_of_other_cameras_count_too(tmp_path):
    pixels = np.zeros((4, 6), np.uint16)
    pose = [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    write_image(tmp_path / "left.png", pixels)
    write_image(tmp_path / "right.png", np.zeros((8, 6), np.uint16))
    write_manifest(tmp_path, {
        "schema": "relit.capture/1", "name": "pair", "camera": {"projection": "perspective", "resolution": [6, 4], "focal_px": [9, 9]},
        "other_cameras": [{"name": "right", "resolution": [6, 8], "focal_px": [9, 9], "camera_from_other": pose}],
        "frames": [{"image": "left.png", "stereo": {"images": ["right.png"]}}]})
    admit_capture(tmp_path, max_pixels=48)
    with pytest.raises(ImageError, match=r"other_cameras\[0\].resolution: 6x8 is more than 47 pixels"):
        admit_capture(tmp_path, max_pixels=47)
