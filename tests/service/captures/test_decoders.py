"""Images that other processes decode: the same pixels and sentences, and an end that concerns one image."""

import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path

import cv2
import numpy as np
import pytest

from service.captures import decoders
from service.captures.decoders import Decoders
from stage import inputs
from stage.capture.capture import Capture
from stage.errors import ImageError, ManifestError, StageError, StorageError
from stage.formats import images
from stage.stack.ingest import open_stack
from tests.scenes.captures import make_scene, write_capture, write_exr, write_image
from tests.service.server.api.captures import lying_png
from tests.service.waiting import until

PIXELS = 1 << 20
NOISE = np.random.default_rng(0)


@pytest.fixture
def made():
    with closing(Decoders(PIXELS)) as found:
        yield found


@pytest.fixture
def folder(tmp_path):
    codes = NOISE.integers(0, 256, (20, 30, 3), dtype=np.uint8)
    for suffix in ("png", "tif", "jpg", "dpx", "jxl", "tga", "bmp"):
        write_image(tmp_path / f"a.{suffix}", codes)
    assert cv2.imwrite(str(tmp_path / "a.avif"), codes)
    write_image(tmp_path / "turned.png", codes, Orientation=6)
    write_image(tmp_path / "grey.png", codes[..., 0])
    write_image(tmp_path / "deep.png", NOISE.integers(0, 65536, (20, 30, 4), dtype=np.uint16))
    write_image(tmp_path / "a.hdr", NOISE.random((20, 30, 3)).astype(np.float32))
    write_exr(tmp_path / "half.exr", NOISE.random((20, 30, 3)), np.float16)
    write_exr(tmp_path / "float.exr", NOISE.random((20, 30)))
    return tmp_path


def test_pixels_headers_and_stacks_are_those_of_this_process(folder, made, tmp_path):
    for path in sorted(folder.iterdir()):
        header, recorded, pixels = images.read_header(path), images.read_recorded(path), images.read_pixels(path)
        with images.decoded_by(made):
            assert images.read_header(path) == header
            other = images.read_recorded(path)
            assert other.dtype == recorded.dtype and np.array_equal(other, recorded) and other.flags.writeable
            assert np.array_equal(images.read_pixels(path), pixels)
    write_capture(tmp_path / "cap", make_scene(size=16, lights=5))
    here = open_stack(Capture.open(tmp_path / "cap"), cache=tmp_path / "here")
    with images.decoded_by(made):
        there = open_stack(Capture.open(tmp_path / "cap"), cache=tmp_path / "there")
    assert here.key == there.key and np.array_equal(here.band(0, 256), there.band(0, 256)) and np.array_equal(here.scale, there.scale)


def test_a_fault_has_the_same_sentence(folder, made):
    (folder / "cut.exr").write_bytes((folder / "half.exr").read_bytes()[:-9])
    (folder / "bad.png").write_bytes((folder / "a.png").read_bytes().replace(b"IDAT", b"IDAX"))
    (folder / "text.jpg").write_text("no image")
    (folder / "a.svg").write_text("<svg/>")
    for name in ("cut.exr", "bad.png", "text.jpg", "a.svg", "nothing.png"):
        for read in (images.read_header, images.read_recorded):
            try:
                read(folder / name)
            except StageError as error:
                with images.decoded_by(made), pytest.raises(type(error)) as other:
                    read(folder / name)
                assert str(other.value) == str(error)
    with images.decoded_by(made), pytest.raises(StorageError):
        images.read_header(folder / "nothing.png")


def test_an_image_of_too_many_pixels_is_not_decoded(tmp_path):
    (tmp_path / "a.png").write_bytes(lying_png(30, 20))
    with closing(Decoders(599)) as found, images.decoded_by(found), pytest.raises(ImageError, match="30x20 pixels, 599 are allowed"):
        images.read_recorded(tmp_path / "a.png")


def test_a_process_that_dies_costs_one_image_and_links_out_of_a_folder_are_not_followed(folder, made):
    with images.decoded_by(made):
        images.read_recorded(folder / "a.png")
        idle, = made._idle
        os.kill(idle.process.pid, signal.SIGKILL)
        with pytest.raises(ImageError, match=r"cannot be decoded: its decoder broke off \(exit code -9\)"):
            images.read_recorded(folder / "a.png")
        assert images.read_recorded(folder / "a.png").shape == (20, 30, 3)
    (folder / "in").mkdir()
    (folder / "in" / "link.png").symlink_to(folder / "a.png")
    with images.decoded_by(made):
        assert images.read_recorded(folder / "in" / "link.png").shape == (20, 30, 3)
        with inputs.confined(folder / "in", folder), pytest.raises(ManifestError, match="leads out"):
            images.read_recorded(folder / "in" / "link.png")


def running(monkeypatch, code: str) -> None:
    """Let other code answer in place of the decoder; `asking` is its socket."""
    monkeypatch.setattr(decoders, "COMMAND", (sys.executable, "-c", f"""
import json, mmap, os, signal, socket, sys, time
asking = socket.socket(fileno=int(sys.argv[1]))
data, files, _, _ = socket.recv_fds(asking, 1 << 16, 1)
{code}"""))


@pytest.mark.parametrize(("code", "words"), [
    ("os.kill(os.getpid(), signal.SIGSEGV)", rf"its decoder broke off \(exit code -{int(signal.SIGSEGV)}\)"),
    ("asking.send(b'{')", "broke off"),
    ("memory = os.memfd_create('x', os.MFD_ALLOW_SEALING)\n"
     "socket.send_fds(asking, [json.dumps({'shape': [1000, 1000, 3], 'kind': '<f4'}).encode()], [memory])\ntime.sleep(9)", "is damaged"),
    ("asking.send(json.dumps({'error': 'a.png: ' + json.dumps(sorted(os.environ))}).encode())", r'a\.png: \["LANG|a\.png: \["'),
    ("time.sleep(600)", "it takes longer than 1 seconds"),
])
def test_a_process_that_is_taken_over_can_only_answer(monkeypatch, folder, made, code, words):
    monkeypatch.setattr(decoders, "WALL_S", 1.0 if "600" in code else 60.0)
    monkeypatch.setenv("RELIT_DATABASE_URL", "postgresql://user:secret@host/name")
    running(monkeypatch, code)
    with images.decoded_by(made), pytest.raises(ImageError, match=words) as error:
        images.read_recorded(folder / "a.png")
    assert "RELIT" not in str(error.value)


def test_several_threads_are_served_and_nothing_is_left(folder, tmp_path_factory):
    before = len(os.listdir("/proc/self/fd"))
    found = Decoders(PIXELS)
    path = folder / "a.png"
    expected = images.read_recorded(path)
    with images.decoded_by(found), ThreadPoolExecutor(8) as pool:
        assert all(np.array_equal(pixels, expected) for pixels in pool.map(images.read_recorded, [path] * 40))
    processes = [process.process.pid for process in found._idle]
    assert 1 <= len(processes) <= (os.cpu_count() or 1)
    found.close()
    for process in processes:
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)
    del expected
    assert len(os.listdir("/proc/self/fd")) <= before and threading.active_count() < 40


def test_the_process_ends_with_the_worker(folder):
    code = f"""
import os, signal, sys
sys.path[:0] = {sys.path!r}
from service.captures.decoders import Decoders
from stage.formats import images
found = Decoders({PIXELS})
with images.decoded_by(found):
    images.read_recorded({str(folder / "a.png")!r})
print(found._idle[0].process.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    process = int(done.stdout)

    def has_ended() -> bool:
        with suppress(FileNotFoundError):
            return Path(f"/proc/{process}/stat").read_text().split()[2] == "Z"
        return True

    until(has_ended, "it goes on")
