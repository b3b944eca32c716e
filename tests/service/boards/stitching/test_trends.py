"""What the tiles of a board have in common, which no overlap contradicts, is told by how they tilt and lie."""

import re

import numpy as np
import pytest

from service.boards.stitching.stitching import stitch
from tests.scenes.board import PIXEL, domes, scan
from tests.service.boards.stitching.test_stitching import points

SIDE, STEP = 70, 5e-4
"""Pixels, and metres: tiles of .7 mm overlap by 20 pixels."""


def said(*, bent_m=0.0, size=1.0, seed=3, **options):
    """The sentences about nine tiles, each bent by so much from its middle to its sides, and so many times as large as it says."""
    tiles = points(scan(domes(2.5e-3, 2.5e-3, seed=seed, bow=2e-4), across=3, down=3, side=(SIDE, SIDE), step=(STEP, STEP), seed=seed,
                        **options))
    half = SIDE * PIXEL / 2
    tiles = [tile._replace(z=tile.z + np.float32(bent_m) * (tile.x**2 + tile.y**2) / np.float32(half**2), x=tile.x / np.float32(size),
                           y=tile.y / np.float32(size)) for tile in tiles]
    return [words for words in stitch(tiles).warnings if "tilt the more" in words or "times as far apart" in words]


@pytest.mark.long
def test_tiles_that_are_all_bent_alike_bend_the_board_which_is_said():
    """By 2 µm each, which bends nine tiles by (3 · 500 + 200)²/700² as much: tilts scatter by 5e-4, a twentieth of their trend."""
    [words] = said(bent_m=2e-6)
    board, tile = (float(number) for number in re.findall(r"by ([\d.e-]+) m\b", words))
    assert tile == pytest.approx(2e-6, rel=0.1) and board == pytest.approx(2e-6 * (850 / 350) ** 2, rel=0.1)


@pytest.mark.long
def test_tiles_that_are_all_larger_than_declared_lie_closer_which_is_said():
    """By 2 %: the stage errs by .2 of 50 pixels, and nine tiles tell .2 %."""
    [words] = said(size=1.02, stage=0.2 * PIXEL)
    assert float(re.search(r"lie ([\d.]+) times", words)[1]) == pytest.approx(1 / 1.02, abs=0.005)


@pytest.mark.long
@pytest.mark.parametrize("options", [{}, {"tilt": 5e-3, "stage": 4 * PIXEL, "seed": 4}], ids=["steady", "unsteady stage"])
def test_a_board_that_is_bent_itself_and_an_unsteady_stage_are_not_accused(options):
    assert said(**options) == []
