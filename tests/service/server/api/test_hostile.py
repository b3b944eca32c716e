"""Bad captures, environments and images through a real server and its worker: refused by name, and both go on."""

import json
import os
import pickle
import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from service.captures.admit import MAX_MANIFEST_BYTES, admit_capture
from service.errors import USER_ERRORS
from service.server.base.settings import Settings
from stage import inputs
from stage.errors import MOST_FAULTS
from tests.service.server.api.captures import (
    lying_bmp,
    lying_exr,
    lying_jxl,
    lying_npy,
    lying_png,
    lying_tga,
    lying_tiff,
    manifest,
    write_capture,
    write_image,
)
from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import admitted, error_of, submit

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("worker_lives")]


def edited(**more: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        found = json.loads((folder / "capture.json").read_text())
        (folder / "capture.json").write_text(json.dumps(found | more))

    return change


def named(name: str) -> Callable[[Path], None]:
    return edited(frames=[{"image": name, "light": {"type": "full"}}])


def replaced(name: str, content: bytes, **entry: object) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        edited(frames=[{"image": name, **(entry or {"light": {"type": "full"}})}])(folder)
        (folder / name).write_bytes(content)

    return change


def timed(content: bytes) -> Callable[[Path], None]:
    return replaced("a.npy", content, tof={"type": "cw", "modulation_hz": 3e7, "reference_phase_rad": 0.0})


def linked(name: str, to: Path | str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        (folder / name).unlink()
        (folder / name).symlink_to(to)

    return change


def text(content: str) -> Callable[[Path], None]:
    return lambda folder: (folder / "capture.json").write_text(content) and None


def piped(folder: Path) -> None:
    (folder / "001.exr").unlink()
    os.mkfifo(folder / "001.exr")


def cut(folder: Path) -> None:
    content = (folder / "001.exr").read_bytes()
    (folder / "001.exr").write_bytes(content[:-7])


def step_outside(folder: Path) -> None:
    (folder / "capture.json").unlink()
    (folder / "step1").symlink_to(SAMPLES / "lambert")


def wide(folder: Path) -> None:
    write_image(folder / "001.exr", np.zeros((2, 2), np.float16))


MAX_PIXELS = Settings.model_fields["max_pixels"].default
HUGE = 32_768  # squared: a billion pixels
HOSTILE: dict[str, tuple[Callable[[Path], object], str]] = {
    "parent": (named("../../data/relit.sqlite"), "leads out of the capture's folder"),
    "absolute": (named("/etc/passwd"), "leads out of the capture's folder"),
    "nul": (named("a\0b.exr"), r"frames\[0\].image: has a control character \(U\+0000\)"),
    "name": (edited(name="a\0b\ud800"), r"capture.json: name: has a control character \(U\+0000\)"),
    "half": (edited(name="b\ud800"), r"capture.json: name: has half a character \(U\+D800\)"),
    "long name": (named("x" * 5000), r"frames\[0\].image: has 5000 characters"),
    "missing": (named("nothing.exr"), "nothing.exr is not in the folder"),
    "directory": (named("."), "is no file"),
    "frame link": (linked("001.exr", SAMPLES / "lambert" / "001.exr"), r"frames\[1\].image: 001.exr leads out"),
    "manifest link": (linked("capture.json", SAMPLES / "lambert" / "capture.json"), "capture.json leads out"),
    "circle": (linked("001.exr", "001.exr"), r"frames\[1\].image: 001.exr leads nowhere"),
    "step link": (step_outside, "step1/capture.json leads out"),
    "pipe": (piped, "001.exr is no file"),
    "truncated": (cut, "001.exr: is truncated"),
    "size": (wide, "001.exr: is 2x2, camera.resolution says 8x8"),
    "billion exr": (replaced("big.exr", lying_exr(HUGE, HUGE)), "big.exr: "),
    "billion tiles": (replaced("big.exr", lying_exr(HUGE, HUGE, 1)), "big.exr: "),
    "billion png": (replaced("big.png", lying_png(HUGE, HUGE)), "big.png: "),
    "billion tiff": (replaced("big.tif", lying_tiff(HUGE, HUGE)), "big.tif: "),
    "channels": (replaced("big.tif", lying_tiff(8, 8, 65_535)), "big.tif: "),
    "billion tga": (replaced("big.tga", lying_tga(65_535, 65_535)), "big.tga: "),
    "billion bmp": (replaced("big.bmp", lying_bmp(HUGE, HUGE)), "big.bmp: "),
    "billion jxl": (replaced("big.jxl", lying_jxl(HUGE, HUGE)), f"big.jxl: has {HUGE}x{HUGE} pixels"),
    "camera": (edited(camera=manifest([], side=HUGE)["camera"]), f"camera.resolution: {HUGE}x{HUGE}"),
    "text": (replaced("a.exr", b"no image"), "a.exr: is not an OpenEXR file"),
    "suffix": (replaced("a.svg", b"<svg/>"), "a.svg: has an unknown suffix"),
    "pickle": (timed(lying_npy("(8, 8)", "|O", pickle.dumps([1]))), "a.npy: is not an array of real numbers"),
    "shape": (timed(lying_npy("(99999999, 99999999)")), "a.npy: has 99999999x99999999 pixels"),
    "bins": (timed(lying_npy("(8, 8, 9999999999999)")), "a.npy: is not a whole .npy array"),
    "empty type": (timed(lying_npy("(8, 8, 9999999999999)", "|V0")), "a.npy: is not an array of real numbers"),
    "negative": (timed(lying_npy("(-8, 8)")), "a.npy: has the shape"),
    "shape code": (timed(lying_npy("__import__('os')")), "a.npy: is not a .npy array"),
    "unknown": (edited(colour="red"), "capture.json: colour: is not a known key"),
    "nested": (text('{"schema":' + "[" * 200_000 + "]" * 200_000 + "}"), "capture.json: is nested too deeply"),
    "long": (text(" " * (MAX_MANIFEST_BYTES + 1)), f"capture.json: has {MAX_MANIFEST_BYTES + 1} bytes"),
    "many frames": (text(json.dumps(manifest([])).replace('"frames": []', '"frames": [' + "0," * (MAX_MANIFEST_BYTES // 2 - 200) + "0]")),
                    r"capture.json: frames\[0\]: is 0: must be an object"),
    "many keys": (lambda folder: text("{" + ",".join(f'"k{number}":0' for number in range(500_000)) + "}")(folder),
                  "capture.json: an object has more than"),
    "not text": (lambda folder: (folder / "capture.json").write_bytes(b"\xff\xfe\0"), "capture.json: is not UTF-8 text"),
    "no json": (text("relit"), "capture.json: is not JSON"),
    "numbers": (text('{"schema": "relit.capture/1", "name": "x", "saturation": NaN}'), "capture.json: NaN is not a JSON number"),
}


def failures(server) -> list[str]:
    """Errors of jobs, one a job."""
    return [line["error"] for line in server.lines() if line["event"] == "job failed"]


THROUGH = ("parent", "nul", "step link", "pipe", "truncated", "billion exr", "billion jxl", "pickle", "bins", "nested", "many frames",
           "many keys")
"""Those that go through the service: one for each way in which a check could cost the worker. The others are checked here."""


def test_hostile_captures_are_refused_by_name(server, client, registered):
    made = {}
    for number, (what, (change, _)) in enumerate(HOSTILE.items()):
        folder = write_capture(registered / f"hostile{number}")
        change(folder)
        if what in THROUGH:
            made[what] = client.post("/v1/captures", json={"name": what, "folder": str(folder)}).raise_for_status().json()["id"]
    for number, (what, (_, sentence)) in enumerate(HOSTILE.items()):
        folder = registered / f"hostile{number}"
        if what in THROUGH:
            found = server.wait(client, f"/v1/captures/{made[what]}", ("ready", "refused"))
            assert found["state"] == "refused", what
            problem = found["problem"]
            assert problem in failures(server) and str(registered) not in problem
        else:
            with pytest.raises(USER_ERRORS) as caught, inputs.confined(folder, registered, max_pixels=MAX_PIXELS):
                admit_capture(folder, max_pixels=MAX_PIXELS)
            problem = str(caught.value)
        assert re.search(sentence, problem), (what, problem)
        faults = problem.split("; ")
        assert problem.isprintable() and len(faults) <= MOST_FAULTS + 1 and max(map(len, faults)) < 400


def test_hostile_environments_are_refused_by_name(server, client, registered):
    folder = registered / "environments"
    folder.mkdir()
    hostile = {"big.exr": (lying_exr(2 * HUGE, HUGE), "big.exr: "), "a.txt": (b"text", "a.txt: an environment is a lat-long"),
               "cut.exr": ((SAMPLES / "owl/environment.exr").read_bytes()[:-9], "cut.exr: is truncated"),
               "square.exr": ((SAMPLES / "owl/000.exr").read_bytes(), "square.exr: is 320x320")}
    for name, (content, sentence) in hostile.items():
        (folder / name).write_bytes(content)
        assert sentence in admitted(server, client, folder / name, "refused", kind="environments")["problem"]


def test_fuzzed_images_through_uploads(server, client, tus, tmp_path):
    """A quarter is cut short, which the check always sees; of the others it lets through what only decoding tells."""
    source = write_capture(tmp_path / "source")
    good = (source / "001.exr").read_bytes()
    made = []
    for seed in range(8):
        numbers, damaged = random.Random(seed), bytearray(good)
        if seed % 4 == 0:
            del damaged[numbers.randrange(8, len(good)) :]
        else:
            for _ in range(numbers.choice((1, 4, 32))):
                damaged[numbers.randrange(len(good))] = numbers.randrange(256)
        capture = f"/v1/captures/{client.post('/v1/captures', json={'name': f'fuzz {seed}'}).json()['id']}"
        for path in source.iterdir():
            tus.send(capture, path.name, bytes(damaged) if path.name == "001.exr" else path.read_bytes())
        client.post(f"{capture}/validate").raise_for_status()
        made.append((seed, capture))
    solves = []
    for seed, capture in made:
        found = server.wait(client, capture, ("ready", "refused"))
        if found["state"] == "refused":
            assert "001.exr" in found["problem"], found["problem"]
        else:
            assert seed % 4, "a file that is cut short was taken for whole"
            solves.append(submit(client, kind="solve", capture=capture.rpartition("/")[2], options={"method": "lambert"}))
    for job in solves:
        ended = server.wait(client, f"/v1/jobs/{job['id']}", ("succeeded", "failed"))
        assert ended["error"] is None or "001.exr" in ended["error"], ended["error"]


def test_a_registered_capture_that_changed_is_not_read(server, client, registered):
    folder = write_capture(registered / "changing")
    capture = admitted(server, client, folder)["id"]

    def solve_error() -> str:
        return error_of(server, client, kind="solve", capture=capture, options={"method": "lambert"})

    shutil.copy(folder / "001.exr", registered / "elsewhere.exr")
    linked("001.exr", registered / "elsewhere.exr")(folder)
    assert "001.exr leads out of the capture's folder" in solve_error()
    (folder / "001.exr").unlink()
    (folder / "001.exr").write_bytes(lying_exr(HUGE, HUGE))
    assert "001.exr" in solve_error()
    folder.rename(registered / "moved")
    folder.symlink_to(SAMPLES / "lambert")
    assert "none of the folders that the operator allows" in solve_error()
    folder.unlink()
    folder.symlink_to(registered.parent)
    assert "none of the folders that the operator allows" in solve_error()
