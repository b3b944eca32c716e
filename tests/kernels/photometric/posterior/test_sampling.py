"""Photometric sampling of pixels that the twin renders: every regime, and none of them with a Lambertian start."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from kernels.errors import ArrayError
from kernels.photometric.material.material import fit_material
from kernels.photometric.posterior.sampling import OPTIONS, Regime, SamplingFit, sampling_tables, solve_sampling
from kernels.photometric.search.hypotheses import LobeShape, search_normals
from tests.kernels.photometric.sources import CENTRES, SHARPNESS, VIEW, readings_of, sphere, table_of
from tests.kernels.scenes import angle_degrees
from tests.reference import sampling as twin

NORMALS = sphere(16)
LAMBERT = twin.lambert(NORMALS, CENTRES, SHARPNESS)


@pytest.fixture(scope="module")
def tables() -> dict:
    """By device, each made once."""
    return {}


def solve(radiance: np.ndarray, device: str, tables: dict, view: np.ndarray = VIEW) -> SamplingFit:
    if device not in tables:
        tables[device] = sampling_tables(table_of(device))
    return solve_sampling(readings_of(radiance, device, view=view), tables[device], np.broadcast_to(view, (len(radiance), 3)))


def mirror(f0: float, normal: np.ndarray = NORMALS, view: np.ndarray = VIEW) -> np.ndarray:
    return twin.mirror(normal, view, CENTRES, SHARPNESS, f0=f0)


def ggx(alpha: float, f0: float, normal: np.ndarray = NORMALS, view: np.ndarray = VIEW) -> np.ndarray:
    return twin.ggx(normal, view, CENTRES, SHARPNESS, alpha=alpha, f0=f0)


@pytest.mark.long
def test_a_mirror(device, tables):
    fit = solve(mirror(0.9), device, tables)
    error = angle_degrees(fit.normal, NORMALS)
    assert error.mean() < 0.15 and error.max() < 0.5  # the last ring is 0.15 degrees
    assert (fit.regime == Regime.MIRROR).all()
    assert np.allclose(fit.specular, 0.9, atol=0.03) and fit.diffuse_albedo.max() < 0.02
    assert fit.roughness.max() < 0.2
    assert np.median(fit.sigma) < 0.25 and np.isfinite(fit.residual).all()


@pytest.mark.long
def test_a_painted_surface(device, tables):
    colour = np.array([0.7, 0.4, 0.1])
    fit = solve(LAMBERT[..., None] * colour, device, tables)
    error = angle_degrees(fit.normal, NORMALS)
    assert error.mean() < 0.15 and error.max() < 0.5
    assert (fit.regime == Regime.LAMBERTIAN).all()
    assert np.allclose(np.median(fit.diffuse_albedo, axis=0), colour, rtol=0.01)
    assert np.median(fit.specular) == 0 and np.median(fit.roughness) == 1


@pytest.mark.long
@pytest.mark.parametrize(("alpha", "mean"), [(0.09, 0.2), (0.25, 0.4)])
def test_a_metal(device, tables, alpha, mean):
    fit = solve(ggx(alpha, 0.8), device, tables)
    assert angle_degrees(fit.normal, NORMALS).mean() < mean
    assert (fit.regime == Regime.GLOSSY).mean() > 0.98
    assert np.median(fit.specular) == pytest.approx(0.8, abs=0.02)
    assert np.median(fit.roughness) == pytest.approx(alpha**0.5, abs=0.02)


@pytest.mark.long
@pytest.mark.parametrize(("specular", "f0", "roughness"), [
    (ggx(0.3, 0.04), 0.04, 0.3**0.5), (mirror(0.3), 0.3, 0.1),
], ids=["plastic", "glazed"])
def test_a_mixture(device, tables, specular, f0, roughness):
    fit = solve(0.4 * LAMBERT + specular, device, tables)
    assert angle_degrees(fit.normal, NORMALS).mean() < 0.25
    assert (fit.regime == Regime.MIXTURE).mean() > 0.97
    assert np.median(fit.diffuse_albedo) == pytest.approx(0.4, abs=0.01)
    assert np.median(fit.specular) == pytest.approx(f0, abs=0.01)
    assert np.median(fit.roughness) == pytest.approx(roughness, abs=0.06)


@pytest.mark.long
def test_brightness_scales_reflectance_alone(device, tables):
    radiance = 0.2 * LAMBERT + mirror(0.2)
    once, twice = solve(radiance, device, tables), solve(2 * radiance, device, tables)
    assert angle_degrees(once.normal, twice.normal).max() < 0.16  # a step of the last ring
    assert np.allclose(2 * once.diffuse_albedo, twice.diffuse_albedo, atol=0.01)


@pytest.mark.long
@pytest.mark.parametrize("surface", ["mirror", "plastic"])
def test_another_view_reads_the_same_table(device, tables, surface):
    """6 degrees off the table's view: a mirror is exact, a lobe to first order."""
    angle = np.radians(6.0)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    view, normal = turn @ VIEW, sphere(12, 0.9) @ turn.T
    radiance = mirror(0.9, normal, view) if surface == "mirror" else \
        0.5 * twin.lambert(normal, CENTRES, SHARPNESS) + ggx(0.2, 0.04, normal, view)
    fit = solve(radiance, device, tables, view)
    assert angle_degrees(fit.normal, normal).mean() < (0.15 if surface == "mirror" else 0.35)  # the table is bilinear between its cells


@pytest.mark.long
def test_the_rings_find_the_diffuse_lobe_whatever_the_start(device, tables):
    """The search with a table takes the place of lights: those of the samples are not looked at."""
    solve(LAMBERT[:3], device, tables)
    samples = readings_of(0.5 * LAMBERT, device)
    found = search_normals(samples, np.broadcast_to(VIEW, NORMALS.shape), shape=LobeShape(),
                           options=replace(OPTIONS, noise_slope=0.3), wide=(tuple(float(d) for d in range(7, 90, 7)), 52),
                           fine=(((2.0, 4.0), 12), ((1.0,), 6)),
                           table=tables[device].search[0])
    assert angle_degrees(found.normal, NORMALS).max() < 2
    assert found.weights.shape == (len(NORMALS), tables[device].search[0].shape[2])
    assert (found.weights[:, 0] > 0).all() and found.weights.min() >= 0


@pytest.mark.long
@pytest.mark.parametrize("alpha", [0.02, 0.12, 0.5])
def test_roughness_between_the_widths_of_the_table(device, tables, alpha):
    solve(LAMBERT[:3], device, tables)
    near = NORMALS[:, 2] > 0.5
    material = fit_material(readings_of(ggx(alpha, 0.6)[near], device), NORMALS[near], shape=LobeShape(), options=OPTIONS,
                            table=tables[device].responses)
    assert np.median(material.specular) == pytest.approx(0.6, abs=0.02)
    assert np.median(material.roughness) == pytest.approx(alpha**0.5, abs=0.06 if alpha < 0.1 else 0.02)


def test_a_table_of_other_lights_is_refused(device, tables):
    solve(LAMBERT[:3], device, tables)
    samples = readings_of(LAMBERT[:3], device)
    for table in (tables[device].search[0], tables[device].responses):
        fewer = wp.array(table.numpy()[:, 1:], dtype=float, device=device)
        with pytest.raises(ArrayError, match="lights"):
            search_normals(samples, NORMALS[:3], shape=LobeShape(), wide=((), 1), table=fewer)
        with pytest.raises(ArrayError, match="lights"):
            fit_material(samples, NORMALS[:3], shape=LobeShape(), table=fewer)


def test_dark_and_missing_readings_do_no_harm(device, tables):
    radiance = mirror(0.9)[:40].copy()
    radiance[0] = 0
    radiance[1, :12] = np.nan
    fit = solve(radiance, device, tables)
    assert np.isfinite(fit.normal).all() and np.isfinite(fit.residual).all() and np.isfinite(fit.specular).all()
    assert angle_degrees(fit.normal[2:], NORMALS[2:40]).max() < 0.5
