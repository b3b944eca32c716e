"""Frames as planes: corrected, grey or colour, in bands, in memory or in a scratch file."""

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.colour.colour import GREY_WEIGHTS
from stage.errors import StorageError
from stage.stack import planes as stage_planes
from stage.stack.planes import frame_planes
from tests.scenes.captures import files_in, write_capture, write_exr


@pytest.fixture
def capture(tmp_path):
    rng = np.random.default_rng(0)
    write_capture(tmp_path, saturation=0.9, dark="dark.exr", frames=[
        {"image": f"{i}.exr", "exposure_s": 0.5, "pattern": {"code": code}} for i, code in enumerate(("black", "white"))])
    write_exr(tmp_path / "dark.exr", np.full((16, 16, 3), 0.1))
    for i in range(2):
        write_exr(tmp_path / f"{i}.exr", 0.2 + rng.random((16, 16, 3)))
    return Capture.open(tmp_path)


@pytest.mark.parametrize("colour", [False, True])
@pytest.mark.parametrize("memory", [True, False])
def test_planes_hold_corrected_frames(capture, monkeypatch, colour, memory):
    from stage.formats import exr

    before = files_in(capture.folder)
    if not memory:
        monkeypatch.setattr(stage_planes, "MEMORY_BYTES", 0)
    monkeypatch.setattr(stage_planes, "BAND_BYTES", 16 * 4 * 2 * 5)
    with frame_planes(capture, capture.manifest.frames, colour=colour) as planes:
        bands = list(planes.bands())
        values = np.concatenate([planes.band(rows, [1]) for rows in bands], axis=-1)
        channels, _ = exr.read(capture.folder / "1.exr")
        recorded = np.stack([channels[name] for name in "RGB"])
        truth = (recorded - np.float32(0.1)) / 0.5
        truth = truth if colour else np.tensordot(GREY_WEIGHTS, truth, 1)[None]
        assert len(bands) > 1 and np.allclose(values[0], truth.reshape(len(truth), -1), atol=1e-6)
        assert (planes.saturated[1] == (recorded >= 0.9).any(axis=0)).all()
    assert files_in(capture.folder) == before


def test_a_folder_that_cannot_be_made_is_named(capture, monkeypatch):
    monkeypatch.setattr(stage_planes, "MEMORY_BYTES", 0)
    with pytest.raises(StorageError, match=r"0\.exr"), frame_planes(capture, capture.manifest.frames, colour=False,
                                                                  cache=capture.folder / "0.exr"):
        pass
