"""The table against direct quadrature of the same sources in float64."""

from functools import cache

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.photometric.model.response_table import COLUMNS, GRID, WIDTHS, nodes, response_table
from tests.kernels.photometric.sources import CENTRES, LIGHTS, SHARPNESS, VIEW, table_of
from tests.reference import sampling as twin

NORMALS = nodes()
CHOSEN = np.random.default_rng(0).choice(np.flatnonzero(NORMALS[:, 2] > 0.2), 25)
IRRADIANCE = twin.irradiance(SHARPNESS)


@cache
def tabulated(device) -> np.ndarray:
    return table_of(device).numpy()


@pytest.fixture
def table(device) -> np.ndarray:
    return tabulated(device)


def worst(found: np.ndarray, truth: np.ndarray) -> float:
    """Largest error over a pixel's brightest light."""
    return float((np.abs(found - truth).max(axis=1) / truth.max(axis=1)).max())


def test_nodes_cover_the_visible_hemisphere():
    assert np.allclose(np.linalg.norm(NORMALS, axis=1), 1) and NORMALS.shape == (GRID * GRID, 3)
    assert NORMALS[:, 2].min() > 0 and NORMALS[:, 2].max() > 0.9999
    for normal in twin.lattice(200):
        if normal[2] > 0:
            assert np.degrees(np.arccos(np.clip((NORMALS @ normal).max(), -1, 1))) < 1.7


def test_lambert(table):
    assert table.shape == (GRID * GRID, LIGHTS, COLUMNS)
    assert worst(table[CHOSEN, :, 0], twin.lambert(NORMALS[CHOSEN], CENTRES, SHARPNESS) / IRRADIANCE) < 0.003


@pytest.mark.parametrize("f0", [0.04, 0.9])
def test_mirror(table, f0):
    truth = twin.mirror(NORMALS[CHOSEN], VIEW, CENTRES, SHARPNESS, f0=f0) / IRRADIANCE
    # each sample spreads over 0.6 of the way to the next
    assert worst(f0 * table[CHOSEN, :, 1] + table[CHOSEN, :, 2], truth) < 0.03


@pytest.mark.parametrize("f0", [0.04, 0.9])
@pytest.mark.parametrize(("width", "error"), [(0, 0.08), (2, 0.03), (4, 0.015), (7, 0.01), (9, 0.01)])
def test_ggx(table, f0, width, error):
    """Narrow lobes are least exact: at grazing angles they are narrower than the samples are apart."""
    truth = twin.ggx(NORMALS[CHOSEN], VIEW, CENTRES, SHARPNESS, alpha=WIDTHS[width], f0=f0) / IRRADIANCE
    assert worst(f0 * table[CHOSEN, :, 3 + 2 * width] + table[CHOSEN, :, 4 + 2 * width], truth) < error


def test_a_single_sample_is_a_distant_light(device):
    light = np.array([[0.6, 0.0, 0.8]])
    table = response_table(light, np.zeros(1), np.zeros(1, dtype=int), np.ones(1), light_count=1, device=device).numpy()
    cosine = NORMALS @ light[0]
    assert np.allclose(table[:, 0, 0], np.maximum(cosine, 0) / np.pi, atol=1e-6)
    alpha, column = WIDTHS[5], 3 + 2 * 5
    half = (light[0] + VIEW) / np.linalg.norm(light[0] + VIEW)
    nl, nv, nh = np.maximum(cosine, 0), NORMALS[:, 2], NORMALS @ half
    distribution = alpha**2 / (np.pi * (nh**2 * (alpha**2 - 1) + 1) ** 2)
    masking = nl * np.sqrt(nv**2 * (1 - alpha**2) + alpha**2) + nv * np.sqrt(nl**2 * (1 - alpha**2) + alpha**2)
    truth = np.where(nl > 0, distribution * nl / 2 / np.maximum(masking, 1e-6), 0)  # F = 1: A + B
    assert np.allclose(table[:, 0, column] + table[:, 0, column + 1], truth, rtol=1e-3, atol=1e-5)


def test_light_is_additive_and_samples_may_be_shared(device):
    """Two lights of the same two samples, one with each and one with both."""
    direction = np.array([[0.6, 0.0, 0.8], [0.0, -0.6, 0.8]])
    rows = np.array([0, 1, 0, 1])
    table = response_table(direction[rows], np.full(4, 0.01), np.array([0, 1, 2, 2]), np.array([1.0, 1.0, 0.25, 0.75]),
                           light_count=3, device=device).numpy()
    assert np.allclose(table[:, 2], 0.25 * table[:, 0] + 0.75 * table[:, 1], rtol=1e-4, atol=1e-6)


def test_arrays_that_do_not_fit_are_refused(device):
    with pytest.raises(ArrayError, match="give one row of each per sample"):
        response_table(np.zeros((2, 3)), np.zeros(1), np.zeros(2, int), np.ones(2), light_count=1, device=device)
