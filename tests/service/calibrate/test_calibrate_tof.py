"""relit calibrate tof: a sweep of simulated captures to a calibration, and the calibration used."""

import json

import numpy as np
import pytest

from service.calibrate.tof import calibrate_tof
from service.errors import RequestError
from service.requests.calibrate import TofCalibrationRequest
from stage.capture.camera import Camera
from stage.errors import StageError
from stage.tof.calibration import read_calibration
from tests.reference import tof
from tests.scenes.tof import cw_frames, pulsed_frames, write
from tests.service.depth.tof.test_tof import run

ROWS, COLS = 12, 16
CAMERA = {"projection": "perspective", "resolution": [COLS, ROWS], "focal_px": [20.0, 20.0]}
SETTINGS = tof.even(tof.HZ, 4)
WAVES = {3: 0.08, 5: -0.02}


def wall(depth_m: float, shift_m: float = 0.0, turn: float = 0.0) -> tof.View:
    """A wall, turned about the upright axis by an angle of this tangent."""
    x, y = Camera.model_validate(CAMERA).plane_coordinates()
    return tof.View(depth_m / (1 - turn * x) * np.sqrt(x**2 + y**2 + 1) + shift_m, np.full((ROWS, COLS), 0.8), np.ones((ROWS, COLS)))


def sweep(folder, steps, frames, turn=0.0):
    for name, depth_m, shift_m, _ in steps:
        write(folder / name, frames(wall(depth_m, shift_m, turn)), camera=CAMERA)
    entries = [{"capture": name, "depth_m": depth_m, **({} if warm is None else {"temperature_c": warm})}
               for name, depth_m, _, warm in steps]
    (folder / "sweep.json").write_text(json.dumps({"schema": "relit.tof-sweep/1", "steps": entries}))
    return folder / "sweep.json"


def cw(view):
    return cw_frames(tof.correlations(view, 1e6, SETTINGS, seed=1, harmonics=WAVES), SETTINGS)


@pytest.mark.long
def test_wiggling_offset_and_drift_of_a_sweep(tmp_path, relit):
    steps = [(f"d{k}", depth, 0.04, 25.0) for k, depth in enumerate(np.linspace(0.8, 7.5, 40))]
    steps += [(f"w{k}", 2.0 + k, 0.04 + 1e-3 * (warm - 25), warm) for k, warm in enumerate((15.0, 35.0, 45.0))]
    outcome = relit.done("calibrate", "tof", sweep(tmp_path, steps, cw), "--out", tmp_path / "camera.json", "--device", "cpu")
    assert "wiggling at 80 MHz" in outcome.out and "before" in outcome.out
    calibration = read_calibration(tmp_path / "camera.json")
    assert calibration.temperature is not None
    assert calibration.temperature.metres_per_c == pytest.approx(1e-3, rel=0.05) and calibration.sigma_m < 5e-4
    folder = write(tmp_path / "new", cw(wall(3.3, 0.04 + 1e-3 * 15)), camera=CAMERA)
    _, maps, _ = run(folder, calibration=tmp_path / "camera.json", temperature_c=40.0)
    assert maps.mask.mean() > 0.99
    assert abs(np.median(maps.depth[maps.mask]) - 3.3) < 2e-3
    assert np.sqrt(np.mean((maps.depth[maps.mask] - 3.3) ** 2)) < 5e-3


@pytest.mark.long
def test_distances_that_contradict_the_others_and_a_turned_target_are_said_and_taken_out(tmp_path, relit):
    """A target turned by 5°, and one distance of 25 that is declared 3 cm too long: as good as a right sweep, which leaves 1.5 mm."""
    steps = [(f"d{k}", depth, 0.04, None) for k, depth in enumerate(np.linspace(0.8, 7.5, 25))]
    path = sweep(tmp_path, steps, cw, turn=np.tan(np.radians(5)))
    plan = json.loads(path.read_text())
    plan["steps"][12]["depth_m"] += 0.03
    path.write_text(json.dumps(plan))
    outcome = relit("calibrate", "tof", path, "--out", tmp_path / "camera.json", "--device", "cpu")
    assert outcome.code == 0 and "d12" in outcome.out and "5° about the upright axis" in outcome.out, outcome.out
    report = json.loads((tmp_path / "calibration.json").read_text())["tof"]
    assert [step["capture"] for step in report["steps"] if not step["used"]] == ["d12"] and len(report["warnings"]) == 2
    folder = write(tmp_path / "new", cw(wall(3.3, 0.04)), camera=CAMERA)
    _, maps, said = run(folder, calibration=tmp_path / "camera.json")
    assert maps.mask.mean() > 0.99 and abs(np.median(maps.depth[maps.mask]) - 3.3) < 2e-3
    assert said["found"]["calibration_sigma_m"] == read_calibration(tmp_path / "camera.json").sigma_m < 1e-3


@pytest.mark.long
def test_what_stands_before_the_target_is_left_out_and_said(tmp_path):
    """A thing 10 cm before the target in a twelfth of every image: it pulled a wall to 8 mm off, at a sigma_m of 2 mm."""
    def frames(view):
        near = view.distance.copy()
        near[4:8, 6:10] -= 0.1
        return cw(view._replace(distance=near))

    path = sweep(tmp_path, [(f"d{k}", depth, 0.04, None) for k, depth in enumerate(np.linspace(0.8, 7.5, 25))], frames)
    made = calibrate_tof(TofCalibrationRequest(sweep=path, out=tmp_path / "c.json", device="cpu"))
    assert any("are off the plane of the target" in words and "mask of the target alone" in words for words in made.warnings)
    _, maps, _ = run(write(tmp_path / "new", cw(wall(3.3, 0.04)), camera=CAMERA), calibration=tmp_path / "c.json")
    assert abs(np.median(maps.depth[maps.mask]) - 3.3) < min(4e-3, 2 * made.calibration.sigma_m)
    plan = json.loads(path.read_text())
    depths = [step["depth_m"] for step in plan["steps"]]
    path.write_text(json.dumps({**plan, "steps": [{**s, "depth_m": d} for s, d in zip(plan["steps"], depths[::-1], strict=True)]}))
    with pytest.raises(RequestError, match=r"--signal of relit import tof.*fall where depth_m grows"):
        calibrate_tof(TofCalibrationRequest(sweep=path, out=tmp_path / "c.json", device="cpu"))


def before_a_wall(depth_m: float, columns: int) -> tof.View:
    """A target over some columns of the picture, before a wall at 8 m that is turned by 17 degrees."""
    target, behind = wall(depth_m), wall(8.0, turn=0.3)
    return target._replace(distance=np.where(np.arange(COLS) < columns, target.distance, behind.distance))


@pytest.mark.parametrize("pulsed", [False, pytest.param(True, marks=pytest.mark.long)], ids=["cw", "pulsed"])
def test_a_target_of_less_than_half_of_the_picture_is_said(pulsed, tmp_path):
    """The ranges of the wall were held against the distances of the target, and depth_m was blamed."""
    def written(columns, depths, declared):
        steps = [{"capture": f"d{columns}-{k}", "depth_m": float(depth)} for k, depth in enumerate(declared)]
        for step, depth in zip(steps, depths, strict=True):
            view = before_a_wall(depth, columns)
            write(tmp_path / step["capture"], pulsed_frames(tof.histogram(view, 1e6, seed=0)) if pulsed else cw(view), camera=CAMERA)
        (tmp_path / "sweep.json").write_text(json.dumps({"schema": "relit.tof-sweep/1", "steps": steps}))
        return TofCalibrationRequest(sweep=tmp_path / "sweep.json", out=tmp_path / "c.json", device="cpu")

    depths = np.linspace(0.8, 6.5, 9)
    with pytest.raises(RequestError, match=r"31% of the pixels of a step lie at its depth_m.*mask of the target alone"):
        calibrate_tof(written(5, depths, depths))
    with pytest.raises(RequestError, match="depth_m, its unit"):
        calibrate_tof(written(COLS, depths, 100 * depths))


@pytest.mark.long
def test_targets_beyond_what_one_frequency_tells_apart_calibrate_it(tmp_path):
    """60 MHz repeat after 2.5 m; the distances were called no wiggling, and depth_m was blamed."""
    settings = tof.even((60e6,), 4)

    def frames(view):
        return cw_frames(tof.correlations(view, 1e6, settings, seed=1, harmonics=WAVES), settings)

    path = sweep(tmp_path, [(f"d{k}", depth, 0.04, None) for k, depth in enumerate(np.linspace(0.4, 6.0, 25))], frames)
    made = calibrate_tof(TofCalibrationRequest(sweep=path, out=tmp_path / "c.json", device="cpu"))
    assert made.steps == 25 and not made.warnings and made.calibration.sigma_m < 1e-3
    _, maps, _ = run(write(tmp_path / "new", frames(wall(1.7, 0.04)), camera=CAMERA), calibration=tmp_path / "c.json")
    assert abs(np.median(maps.depth[maps.mask]) - 1.7) < 1e-3
    plan = json.loads(path.read_text())
    plan["steps"] = [{**step, "depth_m": 1000 * step["depth_m"]} for step in plan["steps"]]
    path.write_text(json.dumps(plan))
    with pytest.raises(RequestError, match="check depth_m, its unit"):
        calibrate_tof(TofCalibrationRequest(sweep=path, out=tmp_path / "c.json", device="cpu"))


@pytest.mark.long
def test_distances_in_another_unit_or_scale_are_told(tmp_path, relit):
    steps = [(f"d{k}", depth, 0.0, None) for k, depth in enumerate(np.linspace(0.8, 7.5, 25))]
    path = sweep(tmp_path, steps, cw)
    plan = json.loads(path.read_text())

    def scaled(factor):
        path.write_text(json.dumps({**plan, "steps": [{**step, "depth_m": factor * step["depth_m"]} for step in plan["steps"]]}))
        return relit("calibrate", "tof", path, "--out", tmp_path / "camera.json", "--device", "cpu")

    outcome = scaled(1.005)
    assert outcome.code == 0 and "1.0050 times too long" in outcome.out
    folder = write(tmp_path / "new", cw(wall(3.3)), camera=CAMERA)
    _, maps, report = run(folder, calibration=tmp_path / "camera.json")
    assert 0.5 < abs(np.median(maps.depth[maps.mask]) - 3.3) / report["found"]["calibration_sigma_m"] < 1.5
    assert any("--tof-calibration" in words for words in report["warnings"])
    before = (tmp_path / "camera.json").read_bytes()
    scaled(100).refused("check depth_m, its unit")
    scaled(1.05).refused("times too long")
    assert (tmp_path / "camera.json").read_bytes() == before


@pytest.mark.long
def test_scale_and_offset_of_a_pulsed_sweep(tmp_path):
    steps = [(f"d{k}", depth, 0.05 + 0.01 * depth, None) for k, depth in enumerate(np.linspace(1, 8, 6))]
    path = sweep(tmp_path, steps, lambda view: pulsed_frames(tof.histogram(view, 1e6, seed=0)))
    result = calibrate_tof(TofCalibrationRequest(sweep=path, out=tmp_path / "c.json", device="cpu"))
    assert result.before_m > 0.05 and result.after_m < 2e-3
    assert result.calibration.offset_m == pytest.approx(0.05, abs=0.01)
    assert result.calibration.sigma_m is not None and result.calibration.sigma_m < 3e-3 and not result.warnings
    plan = json.loads(path.read_text())
    plan["steps"][2]["depth_m"] += 0.2
    path.write_text(json.dumps(plan))
    assert "d2" in calibrate_tof(TofCalibrationRequest(sweep=path, out=tmp_path / "c.json", device="cpu")).warnings[0]
    path.write_text(json.dumps({**plan, "steps": [{**step, "depth_m": step["depth_m"] / 0.3048} for step in plan["steps"]]}))
    with pytest.raises(RequestError, match=r"depth_m grows by 3.2\d m for each metre of the measured ranges: check depth_m, its unit"):
        calibrate_tof(TofCalibrationRequest(sweep=path, out=tmp_path / "c.json", device="cpu"))


@pytest.mark.long
def test_sigma_of_a_pulsed_sweep_grows_away_from_its_distances(tmp_path):
    """Six distances within 30 cm tell little of a wall at 6.3 m: it was ten standard deviations off."""
    count = iter(range(100))

    def pulsed(view):
        return pulsed_frames(tof.histogram(view, 1e6, seed=next(count)))

    path = sweep(tmp_path, [(f"d{k}", depth, 0.05, None) for k, depth in enumerate(np.linspace(3, 3.3, 6))], pulsed)
    found = calibrate_tof(TofCalibrationRequest(sweep=path, out=tmp_path / "c.json", device="cpu")).calibration
    assert 3.0 < found.middle_m < 3.8 and found.sigma_m < 3e-4  # slanting rays; noise of a distance is .1 mm
    folder = write(tmp_path / "far", pulsed(wall(6.3, 0.05)), camera=CAMERA)
    _, maps, said = run(folder, calibration=tmp_path / "c.json")
    sigma = said["found"]["calibration_sigma_m"]
    assert sigma > 3 * found.sigma_m and abs(np.median(maps.depth[maps.mask]) - 6.3) < 4 * sigma


@pytest.mark.long
def test_sigma_of_few_distances_holds_what_chance_makes_of_their_scatter(tmp_path):
    """Distances measured to 5 mm. Two of three are fitted by any line: by the root of their squares alone one in eight is beyond 5 σ."""
    path = sweep(tmp_path, [(f"d{k}", depth, 0.05, None) for k, depth in enumerate((2.0, 3.5, 5.0))],
                 lambda view: pulsed_frames(tof.histogram(view, 1e6, seed=0)))
    plan, random, off = json.loads(path.read_text()), np.random.default_rng(2), []
    for _ in range(16):
        steps = [{**step, "depth_m": step["depth_m"] + random.normal(0, 5e-3)} for step in plan["steps"]]
        path.write_text(json.dumps({**plan, "steps": steps}))
        found = calibrate_tof(TofCalibrationRequest(sweep=path, out=tmp_path / "c.json", device="cpu")).calibration
        off.append(abs(found.scale * 3.55 - found.offset_m - 3.5) / found.sigma_m)
    assert max(off) < 5  # beyond it are 1 % of Student's t of one degree of freedom


@pytest.mark.long
def test_a_pulsed_camera_that_warms_up_on_the_way_has_the_scale_of_one_that_does_not(tmp_path):
    """It drifts by 20 mm while the target moves away by 7 m: fitted after the scale, the drift was 1 mm in 20 and the scale .28 % wrong.
    Noise of a distance is .1 mm, and slanting rays leave 1 mm."""
    def made(name, warm):
        depths = np.linspace(1, 8, len(warm))
        steps = [(f"{name}{k}", depth, 0.05 + 1e-3 * (c - 25), c) for k, (depth, c) in enumerate(zip(depths, warm, strict=True))]
        path = sweep(tmp_path, steps, lambda view: pulsed_frames(tof.histogram(view, 1e6, seed=0)))
        return calibrate_tof(TofCalibrationRequest(sweep=path, out=tmp_path / "c.json", device="cpu")).calibration

    apart = made("a", [20.0, 40.0, 30.0, 20.0, 40.0, 30.0, 20.0, 40.0])
    along = made("b", [20.0, 22.0, 26.0, 25.0, 30.0, 29.0, 36.0, 40.0])
    for found in (apart, along):
        assert found.temperature is not None and found.temperature.metres_per_c == pytest.approx(1e-3, rel=0.2)
    assert along.scale == pytest.approx(apart.scale, abs=1e-3)
    with pytest.raises(RequestError, match="temperature_c rises or falls with depth_m"):
        made("c", [20.0 + 3 * k for k in range(8)])


@pytest.mark.long
def test_sigma_holds_a_drift_that_is_no_line(tmp_path):
    """The drift bends by up to 12 mm, which the line through it misses by some millimetres at all temperatures."""
    warm = (15.0, 20.0, 30.0, 35.0, 45.0)
    steps = [(f"d{k}", depth, 0.04, 25.0) for k, depth in enumerate(np.linspace(0.8, 7.5, 25))]
    steps += [(f"w{k}", 2.0 + k, 0.04 + 1e-3 * (c - 25) + 3e-5 * (c - 25) ** 2, c) for k, c in enumerate(warm)]
    path = sweep(tmp_path, steps, cw)
    found = calibrate_tof(TofCalibrationRequest(sweep=path, out=tmp_path / "c.json", device="cpu")).calibration
    assert 5e-4 < found.sigma_m < 5e-3
    folder = write(tmp_path / "new", cw(wall(3.3, 0.04)), camera=CAMERA)
    _, maps, _ = run(folder, calibration=tmp_path / "c.json", temperature_c=25.0)
    assert abs(np.median(maps.depth[maps.mask]) - 3.3) < 3 * found.sigma_m


@pytest.mark.parametrize(("steps", "message"), [
    ([("d0", 1.0, 0, None)], "steps"),
    ([("d0", 1.0, 0, None), ("d1", 2.0, 0, 20.0)], "temperature_c is missing for some"),
    ([("d0", 1.0, 0, None), ("d1", 1.02, 0, None)], "of a turn"),
])
def test_sweeps_that_say_too_little_are_refused(steps, message, tmp_path):
    with pytest.raises(StageError) as caught:
        calibrate_tof(TofCalibrationRequest(sweep=sweep(tmp_path, steps, cw), out=tmp_path / "c.json", device="cpu"))
    assert message in str(caught.value)
    assert not (tmp_path / "c.json").exists()
