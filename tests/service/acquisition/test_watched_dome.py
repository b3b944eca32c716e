"""The shipped owl under its 96 lamps on the twin of a stage, by the command line alone: a watched folder, solve, export."""

import numpy as np
import OpenEXR
import pytest

from stage.capture.capture import Capture
from stage.formats import images
from tests.service.acquisition.owl_stage import owl_on_stage
from tests.service.owl import OWL, block_mean

CROP = "130,120,48,48"
"""The part of the owl that is solved."""


@pytest.mark.long
def test_the_owl_is_captured_as_its_files_are_imported(tmp_path, relit):
    """Each of 96 pictures is that of its lamp, and what is solved of them is what is solved of the same files when they are imported."""
    with owl_on_stage(tmp_path) as given:
        said = relit.done("capture", "olat", *given, "--out", tmp_path / "capture").out
    assert "fault " not in said and "96 of 96" in said
    capture, imported = tmp_path / "capture", tmp_path / "imported"
    frames, lights = (Capture.open(folder).manifest.frames for folder in (capture, OWL))
    assert np.allclose([frame.light.direction for frame in frames], [frame.light.direction for frame in lights], atol=1e-6)
    seen, lit = (np.stack([block_mean(images.read_pixels(path).astype(np.float32), 8) for path in paths])
                 for paths in ([capture / frame.image for frame in frames], sorted(OWL.glob("[0-9][0-9][0-9].exr"))))
    # the owl's lamps are three times as bright, and the exposure is a quarter
    assert [np.abs(lit / 12 - each).mean(axis=(1, 2, 3)).argmin() for each in seen] == list(range(96))

    rows = [" ".join([frame.image, *map(repr, frame.light.direction)]) for frame in frames]
    (capture / "dome.lp").write_text("\n".join([str(len(rows)), *rows]))
    relit.done("import", "lp", capture / "dome.lp", imported)
    for folder in (capture, imported):
        relit.done("solve", folder, "--crop", CROP, "--out", folder / "maps")
        relit.done("export", folder / "maps", "--out", folder / "asset.usdz")
    maps = [OpenEXR.File(str(folder / "maps" / "maps.exr"), separate_channels=True).channels() for folder in (capture, imported)]
    assert maps[0].keys() == maps[1].keys()
    for name, channel in maps[0].items():
        assert np.array_equal(channel.pixels, maps[1][name].pixels, equal_nan=True), name
    assert (capture / "asset.usdz").stat().st_size > 0
