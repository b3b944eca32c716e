"""Patterns at several exposures: bright and dark surfaces are decoded together, and σ is that of the exposures that each pixel takes."""

import json
from typing import NamedTuple

import numpy as np
import pytest

from stage.formats import exr
from stage.patterns.binary import binary_patterns
from stage.patterns.phase import phase_patterns
from tests.scenes.captures import edit_manifest, write_image, write_images, write_manifest

WIDTH, ROWS, COLS = 256, 48, 160
TIMES = (0.01, 0.16)
U = np.broadcast_to(20.3 + 1.31 * np.arange(COLS), (ROWS, COLS))  # of each pixel in the projector
ALBEDO = np.where(np.arange(ROWS)[:, None] < ROWS // 2, 0.9, 0.02) * np.ones((ROWS, COLS))  # white above, nearly black below
GAIN, READ = 1e-4, 0.002  # of full scale: a photon, and the noise of a reading
PATTERNS = [*binary_patterns(WIDTH, "column", stripe_px=8, inverses=False), *phase_patterns("column", (16.0,), 4)]


class Maps(NamedTuple):
    mask: np.ndarray
    projector_u: np.ndarray
    sigma_u: np.ndarray
    amplitude: np.ndarray


def photographs(times, seed=1):
    """[frames] of each pattern at each time: full scale is a radiance of 0.01 s⁻¹ and the ambient light a hundredth."""
    random = np.random.default_rng(seed)
    found = []
    for pattern in PATTERNS:
        light = (ALBEDO * (0.01 + 0.9 * pattern.level(U, None, WIDTH))) / 0.01
        for time in times:
            mean = light * time
            image = mean + random.normal(size=mean.shape) * np.sqrt(READ**2 + GAIN * mean)
            found.append((pattern, time, np.clip(image, 0, 1)))
    return found


def capture(folder, times, names="{:03d}.png", **fields):
    taken = photographs(times)
    entries = [{"exposure_s": time, "pattern": pattern.model_dump(mode="json", exclude_none=True)} for pattern, time, _ in taken]
    manifest = {"schema": "relit.capture/1", "name": "steps", "camera": {"projection": "orthographic", "resolution": [COLS, ROWS]},
                "projector": {"resolution": [WIDTH, 64]}, "saturation": 1.0,
                "frames": write_images(folder, [image for _, _, image in taken], entries, names), **fields}
    write_manifest(folder, {key: value for key, value in manifest.items() if value is not None})
    return folder


def decoded(relit, folder):
    relit.done("depth", folder, "--out", folder / "out", "--device", "cpu", "--read-noise", READ, "--photon-gain", GAIN)
    layers, _ = exr.read(folder / "out" / "depth.exr")
    maps = Maps(layers["mask.Y"] > 0.5, *(layers[name].astype(np.float64) for name in ("projector.U", "sigma.U", "amplitude.Y")))
    return maps, json.loads((folder / "out" / "report.json").read_text())


def test_bright_and_dark_surfaces_are_decoded_together(relit, tmp_path):
    """Alone, the long exposure clips the white half, and the short one drowns the black half in noise."""
    halves = np.arange(ROWS)[:, None] < ROWS // 2
    share = {}
    for name, times in (("short", TIMES[:1]), ("long", TIMES[1:]), ("both", TIMES)):
        maps, report = decoded(relit, capture(tmp_path / name, times))
        right = maps.mask & (np.abs(maps.projector_u - U) < 1)
        share[name] = right[: ROWS // 2].mean(), right[ROWS // 2 :].mean()
    assert share["short"][1] < 0.9 and share["long"][0] == 0
    assert min(share["both"]) > 0.98, share
    assert report["found"]["exposures_s"] == list(TIMES)
    assert report["found"]["pixels_of_exposures"] == [ROWS * COLS, ROWS * COLS // 2]
    for half in (halves, ~halves):  # of normal errors the mean square over σ² is 1; the decoder adds a little for what is not noise
        ok = np.broadcast_to(half, maps.mask.shape) & maps.mask
        ratio = ((maps.projector_u - U) / maps.sigma_u)[ok]
        assert 0.5 < np.sqrt(np.mean(ratio**2)) < 1.2
    amplitude = [np.median(maps.amplitude[part][maps.mask[part]]) for part in (slice(0, ROWS // 2), slice(ROWS // 2, ROWS))]
    assert amplitude[0] / amplitude[1] == pytest.approx(45, rel=0.05)  # in the unit of the images, not of what was gathered


def test_sigma_falls_with_what_is_gathered(relit, tmp_path):
    """The black half of both exposures has a little less σ than of the long one, and far less than of the short one."""
    sigma = {}
    for name, times in (("long", TIMES[1:]), ("both", TIMES)):
        maps, _ = decoded(relit, capture(tmp_path / name, times))
        below = maps.mask[ROWS // 2 :]
        sigma[name] = np.median(maps.sigma_u[ROWS // 2 :][below])
    assert 0.8 < sigma["both"] / sigma["long"] < 1.4  # read noise is counted twice


def test_a_pattern_without_an_exposure_is_named(relit, tmp_path):
    folder = capture(tmp_path / "c", TIMES)
    edit_manifest(folder, frames=lambda frames: [*frames[:5], *frames[6:]])
    assert "was taken at 0.01 s, other patterns at 0.01, 0.16 s: every" in relit.refused("depth", folder, "--out", folder / "out")


def test_floating_point_images_say_where_they_saturate(relit, tmp_path):
    folder = capture(tmp_path / "c", TIMES, "{:03d}.exr", saturation=None)
    assert "saturation: is missing: exposures of floating-point images" in relit.refused("depth", folder, "--out", folder / "out")


@pytest.mark.parametrize("order", ["exposure", "pattern"])
def test_an_import_names_the_exposures(relit, tmp_path, order):
    taken = photographs(TIMES)
    if order == "pattern":
        taken = sorted(taken, key=lambda one: one[1])
    for number, (_, _, image) in enumerate(taken):
        write_image(tmp_path / "scan" / f"frame_{number}.png", np.rint(image * 65535).astype(np.uint16))
    names = [f"frame_{number}.png" for number in range(len(taken))]
    words = ["import", "phase", tmp_path / "scan", "--projector", f"{WIDTH}x64", "--periods", "16", "--steps", "4", "--exposures-s",
             ",".join(map(str, TIMES)), "--exposure-order", order]
    assert "where these options have 4 patterns at 2 exposures" in relit.refused(*words, "--images", "frame_?.png")
    phases = names[-8:] if order == "exposure" else [*names[len(names) // 2 - 4 : len(names) // 2], *names[-4:]]
    for name in set(names) - set(phases):
        (tmp_path / "scan" / name).unlink()
    outcome = relit(*words)
    assert (outcome.code, outcome.err) == (0, "") and "exposed  0.01, 0.16 s" in outcome.out
    frames = json.loads((tmp_path / "scan" / "capture.json").read_text())["frames"]
    expected = [(step, time) for step in range(4) for time in TIMES] if order == "exposure" else [(s, t) for t in TIMES for s in range(4)]
    assert [(frame["pattern"]["step"], frame["exposure_s"]) for frame in frames] == expected
