"""relit relight run again: what is there of an equal request is kept, all else is made, and an interruption leaves nothing half."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest

import service
from service.relight.opened_capture import open_capture
from service.relight.outputs import RESOLVED, frame_hashes
from service.relight.plan import make_plan
from service.requests.base.base import Role
from service.requests.base.options import role_of
from service.requests.relight import RelightRequest
from stage.formats import exr
from tests.marks import first_short
from tests.scenes.captures import edit_frame, files_in, make_scene, write_capture, write_exr, write_image

SCENE = make_scene(size=8, lights=5)
FRAMES = {f"a.{number}.exr" for number in range(1, 5)}


@pytest.fixture
def made(relit, tmp_path):
    """Run frames 1-4; which of them were made now."""
    write_capture(tmp_path / "cap", SCENE)
    write_exr(tmp_path / "sky.exr", np.random.default_rng(1).random((8, 16, 3)))

    def run(*options):
        times = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "f").glob("*")}
        given = {"--environment": tmp_path / "sky.exr", "--frames": "1-4", **dict(zip(options[::2], options[1::2], strict=True))}
        words = [word for option in given.items() for word in option if word != ""]
        outcome = relit.done("relight", tmp_path / "cap", "--out", tmp_path / "f" / "a.#.exr", *words)
        new = {path.name for path in (tmp_path / "f").glob("*") if times.get(path.name) != path.stat().st_mtime_ns}
        skipped = 4 - len(new)
        rest = "; the others are made" if skipped < 4 else ""
        line = f"skipped  {skipped} of 4 frames were there already, made by an equal run{rest}\n"
        assert (line in outcome.out) == bool(skipped)
        return new

    return run


def test_whole_frames_are_kept_and_others_made(made, tmp_path):
    assert made() == FRAMES
    assert made() == set()
    before = {name: (tmp_path / "f" / name).read_bytes() for name in FRAMES}
    (tmp_path / "f" / "a.2.exr").unlink()
    (tmp_path / "f" / "a.3.exr").write_bytes(before["a.3.exr"][:-9])
    write_exr(tmp_path / "f" / "a.4.exr", np.ones((8, 8, 3)))  # not of relit
    assert made() == {"a.2.exr", "a.3.exr", "a.4.exr"}
    assert {name: (tmp_path / "f" / name).read_bytes() for name in FRAMES} == before  # bit by bit what the first run made
    assert made("--overwrite", "") == FRAMES


@pytest.mark.long
def test_a_frame_with_one_changed_byte_is_made_again(made, tmp_path):
    made()
    path = tmp_path / "f" / "a.2.exr"
    whole = path.read_bytes()
    places = {"first byte": 0, "an attribute": whole.index(b"relit:request"), "the checksum": whole.index(b"relit:checksum") + 30,
              "pixels": len(whole) - 20, "last byte": len(whole) - 1}
    for place in places.values():
        damaged = bytearray(whole)
        damaged[place] ^= 1
        path.write_bytes(damaged)
        assert made() == {"a.2.exr"}
        assert path.read_bytes() == whole
    path.write_bytes(whole + b"\0")
    assert made() == {"a.2.exr"}
    assert made() == set()


@first_short("options", [
    ("--exposure", "1"), ("--compression", "piz"), ("--color-space", "lin_ap1_scene"), ("--aov", "mask"), ("--weights", "smooth"),
])
def test_another_request_makes_frames_anew(made, options):
    made()
    assert made(*options) == FRAMES
    assert made(*options) == set()


def test_turned_frames_are_made_and_the_unturned_one_is_kept(made):
    made()
    assert made("--spin-degrees", "40") == FRAMES - {"a.1.exr"}


def hashes(request: RelightRequest) -> list[str]:
    plan = make_plan(request)
    scheduled = [frame.scheduled for frame in plan.frames]
    return frame_hashes(open_capture(plan.folders[0], request, 1, scheduled), request, scheduled, plan.environments, plan.rate)


def test_a_choice_that_is_added_makes_frames_anew_by_itself(tmp_path):
    class Later(RelightRequest):
        strength: float = 1.0
        """A new choice."""

    class Report(RelightRequest):
        strength: Annotated[float, Role.RUN] = 1.0
        """No choice about the work."""

    given = {"capture": write_capture(tmp_path / "cap", SCENE), "out": str(tmp_path / "a.#.exr"), "frames": "1-2",
             "environment": write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3)))}
    assert len({*hashes(Later(**given)), *hashes(Later(**given, strength=2.0))}) == 2  # unturned frames are equal
    assert hashes(Report(**given)) == hashes(Report(**given, strength=2.0)) == hashes(RelightRequest(**given))


def test_what_the_hash_holds_in_another_form_is_a_choice():
    """The other choices are in it as they are; those in another form change it, as the tests here and in test_align show."""
    assert RESOLVED.keys() <= {name for name, field in RelightRequest.model_fields.items() if role_of(field) is Role.CHOICE}
    assert RESOLVED.keys() == {"frames", "spin_degrees", "exposure", "aov", "align", "align_to", "frames_per_second"}


@pytest.mark.parametrize("change", ["image", "light", "environment", "mask"])
def test_other_inputs_make_frames_anew(made, tmp_path, change):
    made("--aov", "mask")
    if change == "image":
        write_exr(tmp_path / "cap" / "002.exr", SCENE.images[2] * 2)
    elif change == "light":
        edit_frame(tmp_path / "cap", 2, light={"type": "distant", "direction": [0, 0.1, 1], "irradiance": [1, 1, 1]})
    elif change == "environment":
        write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3)))
    else:
        write_image(tmp_path / "cap" / "mask.png", np.full((8, 8), 255, np.uint8))
    assert made("--aov", "mask") == FRAMES


def test_keys_make_those_frames_anew_that_they_change(made, tmp_path):
    def keys(last):
        track = [{"frame": frame, "stops": stops} for frame, stops in ((2, 0), (4, last))]
        (tmp_path / "keys.json").write_text(json.dumps({"schema": "relit.keys/1", "exposure": track}))
        return "--keys", tmp_path / "keys.json"

    made()
    assert made(*keys(1)) == {"a.3.exr", "a.4.exr"}
    assert made(*keys(2)) == {"a.3.exr", "a.4.exr"}
    assert made(*keys(2)) == set()


def test_frames_are_kept_where_the_cache_is_gone(made, tmp_path):
    made()
    for path in (tmp_path / "cap" / ".relit").glob("stack*"):
        path.unlink()
    assert made() == set()
    assert not list((tmp_path / "cap" / ".relit").glob("stack*"))  # and nothing is read in for them


SLOW = """
import time
import service.relight.write as write
from service.cli.main import main
whole = write.exr.write_parts
def slow(*arguments, **options):
    time.sleep(0.1)
    whole(*arguments, **options)
write.exr.write_parts = slow
main()
"""


@pytest.mark.long
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_interrupted_in_the_middle_and_run_again(relit, tmp_path, name):
    cap, out = write_capture(tmp_path / "cap", SCENE), tmp_path / "f"
    sky = write_exr(tmp_path / "sky.exr", np.random.default_rng(1).random((8, 16, 3)))
    arguments = [str(word) for word in ("relight", cap, "--environment", sky, "--frames", "1-40", "--spin-degrees", "90")]
    assert relit(*arguments, "--out", tmp_path / "whole" / "a.##.exr").code == 0  # and the kernels are compiled
    process = subprocess.Popen([sys.executable, "-c", SLOW, *arguments, "--out", str(out / "a.##.exr")], stderr=subprocess.PIPE,
                               text=True, cwd=Path(service.__file__).parents[1])
    for _ in range(600):
        if len(files_in(out)) >= 3 or process.poll() is not None:
            break
        time.sleep(0.1)
    os.kill(process.pid, getattr(signal, name))
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert err.startswith("relit: interrupted; ") and err.count("\n") == 1
    there = files_in(out)
    assert 3 <= len(there) < 40 and all(name.startswith("a.") for name in there)  # no temporary file among them
    kept = {name: (out / name).stat().st_mtime_ns for name in there}
    for name in there:
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    outcome = relit(*arguments, "--out", out / "a.##.exr")
    assert outcome.code == 0 and f"skipped  {len(there)} of 40 frames" in outcome.out
    assert files_in(out) == files_in(tmp_path / "whole")
    for name in files_in(out):
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
        assert name not in kept or kept[name] == (out / name).stat().st_mtime_ns


def test_a_frame_that_cannot_be_written_leaves_the_others_whole(relit, tmp_path):
    cap = write_capture(tmp_path / "cap", SCENE)
    sky = write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3)))
    (tmp_path / "f" / "a.3.exr").mkdir(parents=True)  # in the way
    outcome = relit("relight", cap, "--environment", sky, "--frames", "1-4", "--out", tmp_path / "f" / "a.#.exr")
    assert outcome.code == 2 and f"cannot write {tmp_path}/f/a.3.exr: " in outcome.err and outcome.err.count("\n") == 1
    assert files_in(tmp_path / "f") <= FRAMES
    for name in files_in(tmp_path / "f"):
        exr.read(tmp_path / "f" / name)


def test_results_do_not_replace_each_other(relit, tmp_path):
    write_capture(tmp_path / "cap", SCENE)
    write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3)))
    relit("relight", tmp_path / "cap", "--environment", tmp_path / "sky.exr", "--out", tmp_path / "a.#.exr", "--report",
          tmp_path / "a.1.exr").refused("writes too")
    assert not (tmp_path / "a.1.exr").exists()
