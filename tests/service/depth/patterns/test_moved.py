"""What moves during a sequence is told from what stands still, under projectors of any response: a dark strip that shifts half way."""

import numpy as np
import pytest

from kernels.structured.pattern_frames import NoiseModel
from service.depth.patterns.moved import EvenSums
from service.depth.patterns.pattern_checks import Sample
from stage.patterns.binary import binary_patterns
from stage.patterns.codes import collect
from stage.patterns.phase import phase_patterns

ROWS, COLS, EXTENT = 32, 120, 256
NOISE = NoiseModel(0.003, 1e-4)
STRIPES = list(binary_patterns(EXTENT, "column", stripe_px=8))
NUMBERED = [*phase_patterns("column", (16.0,), 3), *STRIPES]
both = pytest.mark.parametrize("patterns", [NUMBERED, STRIPES], ids=["waves and stripes", "stripes alone"])


def moved(by_px, gamma, full=np.inf, patterns=NUMBERED):
    """Where frames, in the second half of which a dark strip stands farther right, show motion; and where it does."""
    rng = np.random.default_rng(3)
    at = np.arange(COLS) + np.zeros((ROWS, 1))
    frames, albedos = [], []
    for number, pattern in enumerate(patterns):
        left = 50 + 3 * np.sin(np.arange(ROWS) / 4)[:, None] + (by_px if number >= len(patterns) // 2 else 0)
        strip = (at > left) & (at < left + 20)
        albedo = np.where(strip, 0.15, 0.6 + 0.2 * np.sin(0.4 * at))
        u = 20 + 1.6 * at - 30 * strip
        frames.append(albedo * (0.8 * pattern.level(u, u, EXTENT) ** gamma + 0.05))
        albedos.append(albedo)
    values = np.array(frames).reshape(len(patterns), 1, -1)
    values = values + rng.normal(0, 1, values.shape) * np.sqrt(NOISE.read**2 + NOISE.gain * values)
    still = np.zeros((ROWS, COLS), np.float32)
    sample = Sample(np.minimum(values, full).astype(np.float32), (values >= full)[:, 0], still, still, np.ones(still.shape, bool))
    sums = EvenSums.of(sample, collect(patterns), NOISE)
    return sums.moved(sample, NOISE), (np.abs(albedos[0] - albedos[-1]) > 0.2).ravel()


@both
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_what_stands_still_has_not_moved(gamma, patterns):
    """Six deviations of noise: none of 3840 pixels by chance."""
    assert moved(0, gamma, patterns=patterns)[0].sum() == 0


def test_clipped_highlights_that_stand_still_have_not_moved():
    """The mean of a wave whose crests are clipped falls below half of white at the brighter half of the surface."""
    assert moved(0, 1.0, full=0.5)[0].sum() == 0


@both
@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_what_moves_is_found(gamma, patterns):
    found, truth = moved(4, gamma, patterns=patterns)
    assert found[truth].mean() > 0.9 and found[~truth].mean() < 0.01


def test_a_whole_scene_that_moves_is_told_from_single_things():
    """Stripes of paint pass by their own width in the middle of the sequence: every pixel changes."""
    rng, at = np.random.default_rng(3), np.arange(COLS) + np.zeros((ROWS, 1))
    for by_px, everywhere in ((0.0, False), (8.0, True)):
        frames = []
        for number, pattern in enumerate(STRIPES):
            place = at - (by_px if number >= len(STRIPES) // 2 else 0)
            frames.append((0.5 + 0.3 * np.sign(np.sin(np.pi * place / 8))) * (0.8 * pattern.level(20 + 1.6 * at, at, EXTENT) + 0.05))
        values = np.array(frames).reshape(len(STRIPES), 1, -1)
        values = values + rng.normal(0, 1, values.shape) * np.sqrt(NOISE.read**2 + NOISE.gain * values)
        still = np.zeros((ROWS, COLS), np.float32)
        sample = Sample(values.astype(np.float32), None, still, still, np.ones(still.shape, bool))
        assert EvenSums.of(sample, collect(STRIPES), NOISE).everywhere is everywhere
