"""Levels of primaries, their limits and their bits, against independent solutions."""

import json

import numpy as np
import pytest
from scipy.optimize import nnls

from service.drive.levels import dilate, fill, levels_for_light, nonnegative_least_squares, quantise
from stage.errors import ManifestError
from stage.rig.chart import read_chart
from stage.rig.rig import read_rig
from stage.transforms import fibonacci_sphere
from tests.scenes.rigs import RGB, write_rig

WAVELENGTH = np.linspace(400, 700, 61)
RANDOM = np.random.default_rng(3)


def rig_of(tmp_path, count=1, **options):
    write_rig(tmp_path / "rig.json", fibonacci_sphere(count), **options)
    return read_rig(tmp_path / "rig.json")


@pytest.mark.parametrize("count", [1, 3, 4, 6])
def test_non_negative_least_squares_is_that_of_scipy(count):
    matrix = RANDOM.uniform(size=(9, count))
    towards = RANDOM.normal(size=(200, 9))
    ours = nonnegative_least_squares(matrix.T @ matrix, towards @ matrix)
    assert ours == pytest.approx(np.array([nnls(matrix, each)[0] for each in towards]), abs=1e-9)  # float64, condition below 1e3


def test_colours_are_met_by_three_primaries_of_any_colour(tmp_path):
    colours = {"red": (0.9, 0.1, 0.0), "green": (0.1, 0.8, 0.1), "blue": (0.0, 0.1, 1.2)}
    wanted = RANDOM.uniform(0.3, 0.4, (5, 1, 3))
    found = levels_for_light(wanted, rig_of(tmp_path, primaries=colours), None)
    assert found.level @ np.array(list(colours.values())) == pytest.approx(wanted[:, 0], rel=1e-6)
    assert found.out_of_gamut.max() < 1e-6
    outside = levels_for_light(np.array([[[0.0, 0.0, 1.0]]]), rig_of(tmp_path, primaries=colours), None)
    assert outside.level.min() >= 0 and outside.out_of_gamut.sum() > 0.05


def spectra(primaries):
    """Bell-shaped spectra of primaries, patches, and a camera that differs from the eye."""
    def bell(middle, width):
        return np.exp(-(((WAVELENGTH - middle) / width) ** 2))
    shapes = {"red": bell(635, 12), "green": bell(525, 20), "blue": bell(455, 12), "amber": bell(595, 10),
              "white": bell(450, 12) + 0.8 * bell(570, 60)}
    reflectance = np.array([0.05 + 0.8 / (1 + np.exp(-(WAVELENGTH - edge) / 15 * sign)) for edge in np.linspace(430, 670, 12)
                            for sign in (1, -1)])
    camera = np.array([bell(600, 45), bell(540, 45), bell(460, 35)])
    return {name: shapes[name] for name in primaries}, reflectance, camera, np.ones(len(WAVELENGTH))


@pytest.mark.parametrize("names", [("red", "green", "blue", "white"), ("red", "green", "blue", "amber", "white")], ids=["rgbw", "rgbaw"])
def test_patches_look_as_under_the_light_as_nearly_as_spectra_allow(tmp_path, names):
    """Within 5 % of the residual of an independent non-negative fit of the 24 patches; far below that of red, green and blue alone."""
    shapes, reflectance, camera, light = spectra(names)
    data = write_rig(tmp_path / "rig.json", fibonacci_sphere(2), primaries={name: RGB.get(name, (1, 1, 1)) for name in names})
    for lamp in data["lights"]:
        for primary in lamp["primaries"]:
            primary["spectrum"] = {"wavelength_nm": WAVELENGTH.tolist(), "power": shapes[primary["name"]].tolist()}
    (tmp_path / "rig.json").write_text(json.dumps(data))
    (tmp_path / "chart.json").write_text(json.dumps({"schema": "relit.chart/1", "spectra": {
        "wavelength_nm": WAVELENGTH.tolist(), "reflectance": reflectance.tolist(), "sensitivity": camera.tolist(),
        "illuminant": light.tolist()}}))
    colour = np.array([0.8, 1.0, 0.6])
    found = levels_for_light(colour[None, None] * np.ones((1, 2, 1)), read_rig(tmp_path / "rig.json"), read_chart(tmp_path / "chart.json"))
    step = WAVELENGTH[1] - WAVELENGTH[0]
    readings = np.stack([(reflectance * shape) @ camera.T * step for shape in shapes.values()])  # [primaries, patches, 3]
    target = (reflectance * light) @ camera.T * step * colour
    matrix = readings.reshape(len(names), -1).T

    def residual(levels):
        return np.linalg.norm(matrix @ levels - target.ravel())

    best = residual(nnls(matrix, target.ravel())[0])
    assert residual(found.level[0, : len(names)]) <= 1.05 * best
    assert found.level[0, : len(names)] == pytest.approx(found.level[0, len(names) :])
    three = np.zeros(len(names))
    three[:3] = nnls(matrix[:, :3], target.ravel())[0]
    assert best < 0.7 * residual(three)


def test_a_chart_names_what_it_lacks(tmp_path):
    rig = rig_of(tmp_path)
    patch = [[0.1, 0.2, 0.3]]
    (tmp_path / "chart.json").write_text(json.dumps({"schema": "relit.chart/1", "target": patch, "primaries": {"red": patch}}))
    with pytest.raises(ManifestError, match=r"chart.json.*green"):
        levels_for_light(np.ones((1, 1, 3)), rig, read_chart(tmp_path / "chart.json"))
    (tmp_path / "chart.json").write_text(json.dumps({"schema": "relit.chart/1", "target": patch}))
    with pytest.raises(ManifestError, match="spectra"):
        read_chart(tmp_path / "chart.json")


def test_an_excess_fills_the_nearest_lamps(tmp_path):
    """The radius is within a tenth of the least that holds the energy, which is found by adding lamps one by one; 200 random excesses."""
    for _ in range(200):
        angle, spare = np.sort(RANDOM.uniform(0, np.pi / 2, 300)), RANDOM.uniform(0, 1, 300)
        excess = RANDOM.uniform(0.5, 0.9 * spare.sum())
        taken, rest = fill(angle, spare, excess)
        least = angle[np.searchsorted(np.cumsum(spare), excess)]
        assert rest == 0 and taken.sum() == pytest.approx(excess) and (taken <= spare * (1 + 1e-9)).all()
        assert angle[taken > 0].max() <= 1.1 * least
    taken, rest = fill(angle, spare, spare.sum() + 1)
    assert rest == pytest.approx(1) and taken.sum() == pytest.approx(spare.sum())


def test_two_suns_are_two_discs(tmp_path):
    rig = rig_of(tmp_path, count=331)
    level = np.zeros((1, 993))
    level[0, [3 * 10, 3 * 320]] = 12.0
    dilated = dilate(level, rig)
    lit = dilated.level[0, ::3] > 0
    cosine = np.maximum(rig.directions @ rig.directions[10], rig.directions @ rig.directions[320])
    assert dilated.level.sum() == pytest.approx(24) and dilated.level.max() <= 1 and dilated.left.max() == 0
    assert np.degrees(np.arccos(cosine[lit].min())) < 30  # a dozen lamps of 331 are a disc of radius 22 degrees


def test_steps_keep_limits_and_least_levels(tmp_path):
    rig = rig_of(tmp_path, count=60, bits=8, least=0.1)
    level = RANDOM.uniform(0, 1.0, (4, 180)) * (RANDOM.uniform(size=(4, 180)) > 0.3)
    quantised = quantise(level, rig)
    lit = quantised.step > 0
    assert quantised.step.max() <= 255 and (quantised.step[lit] >= 26).all() and not lit[level == 0].any()
    assert quantised.level == pytest.approx(quantised.step / 255)
    assert quantised.level.sum(axis=1) == pytest.approx(level.sum(axis=1), abs=0.8)  # a lamp of each primary ends the tour with its rest
