

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kernels.errors import ArrayError
from kernels.relight.directions.latlong import shared_turns
from kernels.relight.weights.cells import integrate_cells
from service.relight.weights.quadrature import integrate_kernel
from service.relight.weights.weighting import integrate, light_weights
from service.requests.relight import LightWeights
from stage.transforms import rotation_about, rotation_about_y
from tests.kernels.relight.lights import AXES, STILL, turn
from tests.marks import first_short
from tests.reference.relight import texel_solid_angles
from tests.reference.sampling import lattice


def test_the_weightings_differ_and_agree_in_sum(device):
    environment = np.random.default_rng(0).random((9, 18, 3))
    kernel, cells, smooth = (integrate(environment, lattice(20, 180), STILL, weighting=w, device=device)[0] for w in LightWeights)
    np.testing.assert_array_equal(kernel, integrate_kernel(environment, lattice(20, 180), STILL)[0])
    np.testing.assert_array_equal(cells, integrate_cells(environment, lattice(20, 180), STILL, device=device).energy[0])
    for one, other in ((kernel, cells), (cells, smooth), (smooth, kernel)):
        assert np.abs(one - other).max() > 0.01
        np.testing.assert_allclose(one.sum(axis=0), other.sum(axis=0), rtol=1e-12)


@pytest.mark.long
@settings(max_examples=15, deadline=None)
@given(count=st.integers(4, 20), seed=st.integers(0, 100), weighting=st.sampled_from(LightWeights))
def test_weights_place_the_whole_energy(count, seed, weighting):
    """Σ w E = ∫ L dω in each channel, whatever the lights' colours and the scales of their images."""
    rng = np.random.default_rng(seed)
    environment, irradiance = rng.gamma(0.5, 2.0, (10, 20, 3)), rng.uniform(0.1, 5, (count, 3))
    scale = np.zeros(-(-count // 8) * 8, dtype=np.float32)
    scale[:count] = 2.0 ** rng.integers(-5, 5, count)
    given = integrate(environment, lattice(count, 180), np.stack([np.eye(3), turn(7)]), weighting=weighting, device="cpu")
    weights = light_weights(given, irradiance, scale)
    assert weights.shape == (2, 3, len(scale)) and weights.dtype == np.float32 and (weights[:, :, count:] == 0).all()
    total = (environment * texel_solid_angles(10, 20)[..., None]).sum(axis=(0, 1))
    placed = np.einsum("fcl,lc,l->fc", weights[:, :, :count].astype(float), irradiance, 1 / scale[:count])
    np.testing.assert_allclose(placed, [total, total], rtol=1e-6)  # float32 weights


def test_a_light_without_a_channel_is_refused():
    given = integrate_cells(np.ones((4, 8, 3)), AXES, STILL, device="cpu").energy
    irradiance = np.ones((6, 3))
    irradiance[4, 1] = 0
    with pytest.raises(ArrayError, match="irradiance of light 4 is 0 in channel G"):
        light_weights(given, irradiance, np.ones(8, dtype=np.float32))


def spotted(value, count):
    environment = np.ones((4, 8, 3))
    environment[0, :count, 1] = value
    return environment


@pytest.mark.parametrize("weighting", LightWeights)
@pytest.mark.parametrize("environment, directions, rotations, message", [
    (np.ones((4, 8)), AXES, STILL, r"environment is \(4, 8\): give \[rows, cols, 3\]"),
    (np.ones((4, 8, 4)), AXES, STILL, r"environment is \(4, 8, 4\)"),
    (np.ones((0, 8, 3)), AXES, STILL, r"environment is \(0, 8, 3\)"),
    (spotted(np.nan, 3), AXES, STILL, "environment has 3 texels that are not finite"),
    (spotted(np.inf, 2), AXES, STILL, "environment has 2 texels that are not finite"),
    (spotted(-1e-3, 5), AXES, STILL, "environment has 5 texels that are negative"),
    (np.ones((4, 8, 3)), AXES[:0], STILL, r"directions are \(0, 3\): give \[lights, 3\], one light or"),
    (np.ones((4, 8, 3)), AXES[:, :2], STILL, r"directions are \(6, 2\)"),
    (np.ones((4, 8, 3)), AXES * [[1], [1], [2], [1], [1], [1]], STILL, "direction of light 2 is not a unit vector"),
    (np.ones((4, 8, 3)), AXES * [[1], [1], [np.nan], [1], [1], [1]], STILL, "direction of light 2 is not a unit vector"),
    (np.ones((4, 8, 3)), AXES, np.eye(3), r"rotations are \(3, 3\): give \[frames, 3, 3\]"),
])
def test_bad_arguments_are_refused(environment, directions, rotations, message, weighting, device):
    with pytest.raises(ArrayError, match=message):
        integrate(environment, directions, rotations, weighting=weighting, device=device)


SKY = np.random.default_rng(8).random((36, 72, 3))
"""Cut into 720 columns of half a degree."""
SUM = 1e-5
"""The rounding of float32 cosines, which tell a border's place to that part of a sample."""


def spin(frames, degrees=360.0):
    return np.stack([rotation_about_y(degrees * frame / frames) for frame in range(frames)])


@pytest.mark.parametrize(("rotations", "searches"), [
    (spin(24), 1), (spin(48), 1), (spin(100), 5), (spin(7), 7), (np.stack([rotation_about_y(d) for d in (-400, 10.25, 0.75, 5.5)]), 2),
    (np.stack([rotation_about((1.0, 0.0, 0.0), d) for d in (0, 5, 10)]), 3),
])
def test_turns_by_whole_columns_are_found_once(rotations, searches):
    turns = list(shared_turns(rotations, 720))
    assert len(turns) == searches
    assert sorted(frame for turn in turns for frame in turn.frames) == list(range(len(rotations)))
    for found in turns:
        for frame, columns in zip(found.frames, found.columns, strict=True):
            assert np.allclose(rotation_about_y(columns * 0.5) @ found.rotation, rotations[frame], atol=1e-8)


@first_short("weighting", list(LightWeights))
def test_shared_turns_give_the_sums_of_single_ones(weighting, device):
    rotations, lights = spin(48), lattice(40, 180)
    whole = integrate(SKY, lights, rotations, weighting=weighting, device=device)
    for frame in (0, 1, 5, 24, 47):
        single = integrate(SKY, lights, rotations[frame][None], weighting=weighting, device=device)
        assert np.allclose(whole[frame], single[0], rtol=0, atol=SUM * single.max())
    assert np.allclose(whole.sum(axis=1), whole[0].sum(axis=0), rtol=1e-12)
