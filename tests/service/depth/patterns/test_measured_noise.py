"""Frames that are noisier than --read-noise and --photon-gain say: named, and held by σ."""

import json

import numpy as np
import pytest

from tests.marks import first_short
from tests.scenes.captures import write_images, write_manifest
from tests.scenes.depth import BLACK_WHITE, depth_of, entries_of, gray_patterns, make_scene, phase_patterns, shown, write_patterns

NOISE = 0.02
SCENE = make_scene()
WAVES = [*phase_patterns("column", 16.0), *gray_patterns("column", stripe=8, inverse=False), *BLACK_WHITE]
CODES = {"waves": WAVES, "two waves": [*phase_patterns("column", 32.0), *phase_patterns("column", 36.0, 5)],
         "three shifts": [*phase_patterns("column", 16.0, 3), *gray_patterns("column", stripe=8)],
         "three shifts, no inverses": [*phase_patterns("column", 16.0, 3), *gray_patterns("column", stripe=8, inverse=False), *BLACK_WHITE],
         "three periods": [frame for period in (16.0, 18.0, 21.0) for frame in phase_patterns("column", period, 3)],
         "ramp": [*({"code": "ramp", "axis": "column", "direction": way} for way in ("up", "down")), *BLACK_WHITE]}


def measured(folder, patterns, noise, **options):
    """|error| / σ of the solved depths, the factor of the report or None, and what is said of noise."""
    write_patterns(folder, SCENE, patterns, noise=noise)
    result = depth_of(folder, **options)
    maps, report = result.maps, json.loads((folder / "out" / "report.json").read_text())
    off = np.abs(maps.depth - SCENE.depth)[maps.mask] / maps.sigma[maps.mask]
    return off, report["found"].get("noise_factor"), [warning for warning in result.warnings if "times as noisy" in warning]


@first_short("name", CODES)
def test_noise_beyond_what_is_declared_is_named_and_held_by_sigma(tmp_path, name):
    """The noise of the default at the mean level is .0055, and that of grey images the same in all channels."""
    off, factor, said = measured(tmp_path, CODES[name], NOISE)
    assert len(said) == 1 and factor == pytest.approx(3.5, rel=0.15)
    assert 0.5 < np.median(off) < 1.0 and (off > 5).mean() < 0.01  # .67 where σ is right


@first_short("noise", [0.0, 0.004, NOISE])
def test_right_noise_is_not_named(tmp_path, noise):
    assert measured(tmp_path, WAVES, noise, read_noise=max(noise, 0.003))[1:] == (None, [])


@pytest.mark.parametrize("rows", [1, 2])
def test_images_of_few_rows_tell_it_too(tmp_path, rows):
    """The noise of the default at the mean level is .0066."""
    random, place = np.random.default_rng(3), np.broadcast_to(20 + 0.5 * np.arange(420), (rows, 420))
    waves = [wave for period in (16.0, 18.0, 21.0) for wave in phase_patterns("column", period)]
    uv = np.stack([place, np.zeros(place.shape)], axis=-1)
    images = [0.1 + 0.6 * shown(wave, uv) + NOISE * random.standard_normal(place.shape) for wave in waves]
    write_manifest(tmp_path, {
        "schema": "relit.capture/1", "name": "line", "color_space": "lin_rec709_scene",
        "frames": write_images(tmp_path, images, entries_of(waves), "{}.png"),
        "camera": {"projection": "orthographic", "resolution": [420, rows]}, "projector": {"resolution": [256, 64]}})
    depth_of(tmp_path)
    told = json.loads((tmp_path / "out" / "report.json").read_text())["found"]
    assert told["noise_factor"] == pytest.approx(3.0, rel=0.15)


def test_stripes_alone_are_decoded_as_declared(tmp_path):
    """They are read rightly in far more noise, and half of the pixels would be lost to it."""
    off, *told = measured(tmp_path, [*gray_patterns("column", inverse=False), *BLACK_WHITE], NOISE)
    assert told == [None, []] and (off > 5).mean() < 0.01
