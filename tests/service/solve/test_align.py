"""relit solve and relight --align: a moving subject, from images on disk to results."""

import json

import numpy as np
import pytest

from stage.formats import exr
from tests.scenes.captures import angles_degrees, files_in, write_exr
from tests.scenes.moving import RADIUS, Subject, write_moving

GLIDING = Subject(shift_px=(0.43, -0.31))
TURNING = Subject(turn_degrees=0.4)


def errors(relit, folder, subject, *arguments) -> np.ndarray:
    """Return the errors of the normals in degrees, but for a rim of four pixels, half a patch of the flow's search.

    Aligned normals must be solved; unaligned ones may be unsure.
    """
    maps, *_ = relit.solve(folder, "--method", "lambert", *arguments, unsure=True)
    inner = np.hypot(*subject.body(0)) < RADIUS * subject.size - 4
    assert (maps.mask if "--align" in arguments else maps.estimated)[inner].mean() > 0.99
    return angles_degrees(maps.normal, subject.normal(0))[inner & maps.estimated]


@pytest.mark.long
def test_aligned_normals_are_close_to_those_of_a_subject_that_stands_still(relit, tmp_path):
    write_moving(tmp_path, TURNING)
    found = errors(relit, tmp_path, TURNING, "--align")
    # 0.03 px of flow; and the surface turns with the subject, by up to 0.4 degrees times five, which no warp takes back
    assert np.median(found) < 0.4 and np.percentile(found, 95) < 1.5
    assert np.median(errors(relit, tmp_path, TURNING)) > 10 * np.median(found)


@pytest.mark.long
def test_a_subject_that_stands_still_loses_nothing(relit, tmp_path):
    write_moving(tmp_path, Subject())
    found = errors(relit, tmp_path, Subject(), "--align")
    assert np.allclose(found, errors(relit, tmp_path, Subject()), atol=0.02)  # half rounding


def test_the_report_and_the_maps_say_that_frames_were_aligned(relit, tmp_path):
    write_moving(tmp_path, GLIDING)
    found = errors(relit, tmp_path, GLIDING, "--align")
    # 0.01 px of flow and interpolation change a reading by 0.1 %, and so this normal by 0.1 degrees
    assert np.median(found) < 0.15 and np.percentile(found, 95) < 0.5
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    unaligned = {"capture": str(tmp_path), "method": "lambert", "reference_ball": None, "align": False, "align_to": None,
                 "albedo_scale": None, "crop": None, "clip_negative": False, "lights": "declared", "intensities": "chosen",
                 "materials": "coherent", "max_sigma": None, "least_confidence": None, "temporal": True, "frame_rate": None}
    assert report["options"] == unaligned | {"align": True}
    assert report["inputs"]["content"].startswith("aligned-") and report["inputs"]["frames"] == 8
    assert report["motion"]["reference"] == "05.exr" and len(report["motion"]["intervals"]) == 2
    metadata = exr.read_header(tmp_path / "out" / "maps.exr").metadata
    assert json.loads(metadata["relit:options"]) == {"method": "lambert", "align": True, "intensities": "chosen", "lights": "declared",
                                                        "materials": "coherent"}
    assert np.median(errors(relit, tmp_path, GLIDING)) > 10 * np.median(found)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert "motion" not in report and report["options"] == unaligned
    assert len([name for name in files_in(tmp_path / ".relit") if name.endswith("json") and "stack" in name]) == 2


@pytest.mark.long
def test_another_time_may_be_named(relit, tmp_path):
    write_moving(tmp_path, GLIDING)
    maps, report, _ = relit.solve(tmp_path, "--align-to", "10.exr", "--method", "lambert")
    inner = np.hypot(*GLIDING.body(5)) < RADIUS * GLIDING.size - 4
    assert np.median(angles_degrees(maps.normal, GLIDING.normal(5))[inner & maps.mask]) < 0.15
    assert report["motion"]["reference"] == "10.exr"


@pytest.mark.long
def test_a_relit_frame_shows_the_common_time(relit, tmp_path):
    frames = {}
    write_exr(tmp_path / "even.exr", np.ones((8, 16, 3)))
    for name, subject, arguments in (("still", Subject(), ()), ("moving", GLIDING, ()), ("aligned", GLIDING, ("--align",))):
        write_moving(tmp_path / name, subject)
        relit.done("relight", tmp_path / name, "--environment", tmp_path / "even.exr", *arguments,
                   "--out", tmp_path / name / "frame.#.exr")
        frames[name] = exr.read(tmp_path / name / "frame.1.exr")[0]["R"].astype(np.float64)[GLIDING.mask(0)]
    after, before = (np.abs(frames[name] / frames["still"] - 1) for name in ("aligned", "moving"))
    assert np.median(after) < 0.005 < 0.03 < np.median(before)


@pytest.mark.parametrize(("order", "arguments", "words"), [
    ("LLLL", ["--align"], "0 lit by a full light: --align follows the subject through"),
    ("LLTLL", ["--align"], "1 lit by a full light"),
    ("TLLLLT", ["--align-to", "01.exr"], "01.exr is no tracking frame: --align-to takes one of 00.exr"),
    ("TTLLLL", ["--align"], "frames[3]: lies more than one tracking interval after the"),
])
@pytest.mark.parametrize("command", ["solve", "relight"])
def test_what_cannot_be_aligned_is_one_sentence(relit, tmp_path, command, order, arguments, words):
    write_moving(tmp_path / "cap", Subject(size=16), order)
    write_exr(tmp_path / "even.exr", np.ones((2, 4, 3)))
    more = ["--out", tmp_path / "out"] if command == "solve" else ["--environment", tmp_path / "even.exr", "--out",
                                                                   tmp_path / "out" / "a.#.exr"]
    outcome = relit(command, tmp_path / "cap", *arguments, *more)
    assert outcome.code == 2 and outcome.err.startswith("relit: ") and outcome.err.count("\n") == 1
    assert words in outcome.err and not (tmp_path / "out").exists()


def test_dark_tracking_frames_are_one_sentence(relit, tmp_path):
    write_moving(tmp_path / "cap", Subject(size=16), "TLLLLT")
    for name in ("00.exr", "05.exr"):
        write_exr(tmp_path / "cap" / name, np.zeros((16, 16, 3)))
    assert "05.exr: is dark inside the mask" in relit.refused("solve", tmp_path / "cap", "--align", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_constant_subject_moves_nowhere(relit, tmp_path):
    """Flow has nothing to hold on to, and makes nothing up."""
    write_moving(tmp_path / "cap", Subject(size=16), "TLLLLT", mask=None)
    for index in range(6):
        write_exr(tmp_path / "cap" / f"{index:02d}.exr", np.ones((16, 16, 3)))
    _, report, _ = relit.solve(tmp_path / "cap", "--align", "--method", "lambert", "--max-sigma", "180", code=1)  # no normal is solved
    motion = report["motion"]
    assert motion["intervals"][0]["displacement_px"] == {"median": 0, "max": 0} and motion["no_reading_fraction"] == 0
