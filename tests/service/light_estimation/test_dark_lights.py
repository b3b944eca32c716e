"""Frames whose lamp did not burn are named, and left out of a solve; frames that are dark by right are not."""


import numpy as np
import pytest

from service.captures.info import inspect
from service.light_estimation.dark_lights import dark_lights
from service.relight.relight import relight
from service.requests.captures import InfoRequest
from service.requests.relight import RelightRequest
from service.requests.solve import SolveRequest
from service.solve.solve import solve
from tests.scenes import near_lights
from tests.scenes.captures import edit_manifest, make_scene, write_capture, write_exr

SCENE = make_scene(size=32, lights=12)
RNG = np.random.default_rng(5)
UNLIT = [3, 8]


def put_out(folder, peak):
    """Replace two frames by noise, and return their names."""
    names = [f"{index:03d}.exr" for index in UNLIT]
    for name in names:
        write_exr(folder / name, np.maximum(RNG.normal(0, 0.004 * peak, (*SCENE.mask.shape, 3)), 0).astype(np.float32))
    return names


def without(folder):
    """Take these frames out of the manifest."""
    edit_manifest(folder, frames=lambda frames: [frame for index, frame in enumerate(frames) if index not in UNLIT])


@pytest.mark.parametrize("method", ["lambert", *(pytest.param(name, marks=pytest.mark.long) for name in ("robust", "svbrdf"))])
def test_a_solve_leaves_out_what_a_person_would(tmp_path, method):
    write_capture(tmp_path, SCENE)
    names = put_out(tmp_path, SCENE.images.max())
    found = solve(SolveRequest(capture=tmp_path, method=method, out=tmp_path / "found", device="cpu"))
    assert any(", ".join(names) in warning and "left out" in warning for warning in found.warnings)
    without(tmp_path)
    taken_out = solve(SolveRequest(capture=tmp_path, method=method, out=tmp_path / "taken out", device="cpu"))
    assert not any("lamp" in warning for warning in taken_out.warnings)
    assert np.array_equal(found.maps.normal, taken_out.maps.normal) and np.array_equal(found.maps.sigma, taken_out.maps.sigma)


@pytest.mark.long
def test_near_lamps(tmp_path):
    dome = near_lights.dome(32)
    capture = near_lights.write(tmp_path / "capture", dome, near_lights.lamps(dome, 12, 3))
    names = sorted(path.name for path in capture.glob("*.exr"))
    write_exr(capture / names[4], np.zeros((32, 32, 3), np.float32))
    result = solve(SolveRequest(capture=capture, method="robust", out=tmp_path / "out", device="cpu"))
    assert any(f"{names[4]} is dark" in warning for warning in result.warnings)


def test_info_and_frames_tell_of_it(tmp_path):
    write_capture(tmp_path / "capture", SCENE)
    names = ", ".join(put_out(tmp_path / "capture", SCENE.images.max()))
    assert any(names in finding for finding in inspect(InfoRequest(capture=tmp_path / "capture")).findings)
    write_exr(tmp_path / "sky.exr", np.full((16, 32, 3), 0.3, np.float32))
    result = relight(RelightRequest(capture=tmp_path / "capture", environment=str(tmp_path / "sky.exr"), out=str(tmp_path / "frame.#.exr"),
                                    device="cpu"))
    assert any(names in warning and "missing" in warning for warning in result.warnings)


def test_what_is_dark_by_right():
    """Lamps beside and behind, highlights that few of the pixels show, and a stage of which a third was not switched on."""
    turn = 2 * np.pi * np.arange(12) / 12
    across = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    tilted = np.array([0.6, 0.0, 0.8])
    grazing = np.concatenate([0.97 * across, np.full((12, 1), 0.243)], axis=1)
    normal = tilted + 0.05 * RNG.standard_normal((400, 3))
    assert not dark_lights(np.maximum(grazing @ normal.T, 0), np.concatenate([across, np.full((12, 1), 0.1)], axis=1)).any()
    metal = np.full((12, 400), 1e-4)
    metal[:9, 7] = 50.0
    metal[9:, 8] = 40.0
    assert not dark_lights(metal, grazing).any()
    third = np.ones((12, 400))
    third[:4] = 0
    assert not dark_lights(third, grazing).any()
    third[:2] = 1
    assert dark_lights(third, grazing).tolist() == [False, False, True, True] + 8 * [False]
