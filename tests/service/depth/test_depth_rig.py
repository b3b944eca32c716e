"""The committed capture of a path-traced projector and camera, against its ground truth (samples/README.md)."""

from pathlib import Path

import numpy as np
import pytest

from service.depth.depth import depth
from service.requests.depth import DepthRequest
from stage.formats import exr

RIG = Path(__file__).parents[3] / "samples" / "rig"


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    out = tmp_path_factory.mktemp("rig")
    return depth(DepthRequest(capture=RIG, out=out, cache=out, device="cpu")).maps


@pytest.fixture(scope="module")
def truth():
    channels, _ = exr.read(RIG / "truth.exr")
    return {name: values > 0.5 if name.endswith(".Y") else values.astype(np.float64) for name, values in channels.items()}


def test_lit_pixels_are_decoded_and_shadow_is_refused(solved, truth):
    assert solved.mask[truth["mask.Y"]].mean() >= 0.97
    assert solved.mask[truth["shadow.Y"]].mean() < 0.10


def test_columns_and_depths_are_those_of_the_geometry(solved, truth):
    clean = truth["mask.Y"] & ~truth["mixed.Y"] & solved.mask
    column = np.abs(solved.projector_u - truth["projector.U"])[clean]
    assert column.max() < 8  # half a period: no wrong unwrap
    assert np.median(column) <= 0.014
    assert np.median(np.abs(solved.depth - truth["depth.Z"])[clean]) <= 0.30e-3


def test_interreflection_bends_the_phase_only_in_the_groove(solved, truth):
    clean = truth["mask.Y"] & ~truth["mixed.Y"] & solved.mask
    column = np.abs(solved.projector_u - truth["projector.U"])
    open_ground, groove = column[clean & ~truth["groove.Y"]], column[clean & truth["groove.Y"]]
    assert np.percentile(open_ground, 95) < 0.02
    assert np.median(groove) > 5 * np.median(open_ground)  # the sample has the light between its walls
    assert np.median(groove) < 0.1
