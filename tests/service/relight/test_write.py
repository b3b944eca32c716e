"""Frames as files."""

import re

import numpy as np
import pytest

from service.relight.findings import dim_sentences
from service.relight.write import FrameFile, FrameFormat, FrameWriter
from service.requests.light.picture_options import FrameCompression
from stage.formats import exr


@pytest.fixture
def form():
    return FrameFormat((8, 4), "lin_rec709_scene", None, FrameCompression.ZIP, (), (), False, None, None, {})


def test_halves_from_a_gpu_are_written_as_floats_are(form, tmp_path):
    frame = np.random.default_rng(0).normal(0, 1, (3, 32)).astype(np.float32)
    frame[0, :3] = 7e4, -65510, 65504
    halves = np.where(np.abs(frame) > 65504, np.copysign(np.inf, frame), frame).astype(np.float16)
    clipped = []
    for name, values in (("float", frame), ("half", halves)):
        with FrameWriter(lambda count: None) as writer:
            writer.put([FrameFile(tmp_path / f"{name}.exr", 1.0, {})], values[None].copy(), form, {})
        clipped.append(writer.written.clipped)
    one, other = (exr.read(tmp_path / f"{name}.exr")[0] for name in ("float", "half"))
    assert clipped == [2, 2] and one.keys() == other.keys()
    for channel, values in one.items():
        np.testing.assert_array_equal(values, other[channel])


@pytest.mark.parametrize("changed", [{"matrix": np.eye(3)}, {"factor": np.ones(32)}, {"parts": ("specular",)}, {}])
def test_frames_that_are_changed_first_do_not_come_as_halves(form, changed, tmp_path):
    assert not form._replace(**changed).as_computed([FrameFile(tmp_path / "f.exr", 1.0 if changed else 2.0, {})])
    assert form.as_computed([FrameFile(tmp_path / "f.exr", 1.0, {})])


@pytest.mark.parametrize(("peaks", "said"), [((3e-6, 2e-7), "is 3e-06: below 6.1e-05 half floats have steps of 6e-08, .* by 18 to"),
                                             ((1e-8, 0.0), "is 1e-08"), ((3e-6, 0.1), None), ((0.0, 0.0), "every value .* is 0")])
def test_frames_too_dim_for_half_floats_are_said(form, peaks, said, tmp_path):
    """Unless another frame is bright, as where a range fades to black."""
    frames = np.float32([[[peak] * 32] * 3 for peak in peaks])
    with FrameWriter(lambda count: None) as writer:
        writer.put([FrameFile(tmp_path / f"{index}.exr", 1.0, {}) for index in range(2)], frames, form, {})
    found = dim_sentences(writer.written.peak)
    assert len(found) == (said is not None) and all(re.search(str(said), each) for each in found)
