"""relit solve and relit depth on sequences: what is at rest is joined, what moves is not, and what is done is not done again."""

import json

import numpy as np
import pytest

from service.errors import RequestError
from service.requests.depth import DepthRequest
from service.requests.solve import LightsKnown, Method, SolveRequest
from service.sequences import steps
from service.sequences.joined_steps import MapsJoiner
from service.sequences.run import depth_sequence, solve_sequence
from stage.capture.camera import Camera
from stage.errors import ManifestError
from stage.formats.ply import read_ply
from stage.results.depth_maps import DepthMaps
from stage.results.maps import SurfaceMaps
from tests.scenes import depth as depths
from tests.scenes.captures import angles_degrees, edit_manifest, files_in, rms
from tests.scenes.sequence import LIGHTS, SIZE, moment, write_sequence, write_step

STEPS, NOISE = 7, 0.02
PLACES = [12 + 40 * step / (STEPS - 1) for step in range(STEPS)]


def maps_of(out, step):
    """Of a step: joined, and alone."""
    return (SurfaceMaps.read(out / f"step{step:02d}" / part / "maps.exr") for part in (".", "alone"))


def request(folder, **options):
    return SolveRequest(capture=folder / "in", out=folder / "out", method=options.pop("method", Method.ROBUST), device="cpu", **options)


def grown(where, pixels):
    """What is within some pixels of a part of the image."""
    steps = range(-pixels, pixels + 1)
    return np.array([np.roll(where, (down, right), (0, 1)) for down in steps for right in steps]).any(axis=0)


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """The folder, the truth of each step, and where nothing changes within 8 pixels, the largest square that is looked at."""
    folder = tmp_path_factory.mktemp("moving")
    moments = write_sequence(folder / "in", PLACES, noise=NOISE, times=[0.1 * step for step in range(STEPS)])
    result = solve_sequence(request(folder))
    changing = np.any([np.abs(each.normal - moments[0].normal).max(axis=-1) > 0 for each in moments], axis=0)
    return folder / "out", moments, ~grown(changing, 8), result


@pytest.mark.long
def test_what_is_at_rest_is_joined_over_all_steps(moving):
    """The error falls by the root of the steps. Errors of `robust` that all steps share leave 1.10 of that in the plain mean of seven, and
    the 1 to 2 % of the pixels that begin anew in a step, which are those with the largest errors, up to 1.29."""
    out, moments, rest, _ = moving
    for step in range(1, STEPS):
        joined, alone = maps_of(out, step)
        error = [angles_degrees(maps.normal, moments[step].normal)[rest] for maps in (joined, alone)]
        assert np.median(error[0]) < 1.2 * np.median(error[1]) / np.sqrt(step + 1)
        assert rms(error[0]) < 1.35 * rms(error[1]) / np.sqrt(step + 1)
        assert rms(joined.sigma[rest]) == pytest.approx(rms(error[0]), rel=0.25)
        albedo = [np.abs(maps.diffuse_albedo.astype(float) - moments[step].albedo)[rest] for maps in (joined, alone)]
        assert np.median(albedo[0]) < 1.25 * np.median(albedo[1]) / np.sqrt(step + 1)


@pytest.mark.long
def test_normals_and_height_flicker_less(moving):
    """A mean of k steps changes by 1/k of what a step changes: medians of the last steps, of 5, 6 and 7."""
    out, _, rest, _ = moving
    change = {name: {part: [] for part in (0, 1)} for name in ("normal", "height")}
    for step in range(STEPS - 2, STEPS):
        for part, (now, before) in enumerate(zip(maps_of(out, step), maps_of(out, step - 1), strict=True)):
            for name, found in change.items():
                apart = np.abs(getattr(now, name) - getattr(before, name))[rest]
                found[part].append(np.median(np.linalg.norm(apart, axis=-1) if apart.ndim == 2 else apart))
    for name, (joined, alone) in ((name, found.values()) for name, found in change.items()):
        assert np.mean(joined) < 2 * np.mean(alone) / (STEPS - 1), name


@pytest.mark.long
def test_what_moves_is_what_the_step_alone_found(moving):
    out, moments, _, _ = moving
    for step in range(1, STEPS):
        joined, alone = maps_of(out, step)
        inside = moments[step].moving
        error = [rms(angles_degrees(maps.normal, moments[step].normal)[inside]) for maps in (joined, alone)]
        assert error[0] <= 1.01 * error[1]
        changed = inside != moments[step - 1].moving
        error = [rms(angles_degrees(maps.normal, moments[step].normal)[changed]) for maps in (joined, alone)]
        assert error[0] <= 1.02 * error[1]


@pytest.mark.long
def test_the_reports_say_what_was_joined(moving):
    out, _, _, result = moving
    report = json.loads((out / "report.json").read_text())
    assert [row["name"] for row in report["steps"]] == list(result.names) and report["inputs"]["frames_per_second"] == 30
    assert report["steps"][3]["time_s"] == pytest.approx(0.3)
    last = report["steps"][-1]
    assert last["steps_joined"]["median"] == STEPS and 0.5 < last["noise_share"]["normal"] < 1.5
    assert last["joined_pixels"] > 0.75 * SIZE**2
    assert json.loads((out / "sequence.json").read_text())["steps"][1] == {"path": "step01", "time_s": 0.1}
    assert files_in(out / "step00") == {"maps.exr", "report.json", "alone/maps.exr", "alone/report.json", "alone/step.json"}


@pytest.mark.long
def test_a_cut_carries_nothing_over(tmp_path):
    moments = write_sequence(tmp_path / "in", [None] * 6, cut=3, noise=NOISE)
    solve_sequence(request(tmp_path))
    for step, error in ((3, 1.0), (5, 0.75)):
        joined, alone = maps_of(tmp_path / "out", step)
        apart = [rms(angles_degrees(maps.normal, moments[step].normal)) for maps in (joined, alone)]
        assert apart[0] <= (error + 0.01) * apart[1]
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["steps"][3]["joined_pixels"] < 0.005 * SIZE**2 and report["steps"][4]["joined_pixels"] > 0.9 * SIZE**2


@pytest.mark.long
def test_a_change_of_all_lights_is_taken_out(tmp_path):
    """3 % more light in one step: its albedo is that of the others, within the noise of the joined one."""
    for step, brightness in enumerate((1.0, 1.03, 1.0)):
        write_step(tmp_path / "in" / f"step{step:02d}", moment(None), seed=step, noise=NOISE, brightness=brightness)
    solve_sequence(request(tmp_path))
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [row.get("brightness") for row in report["steps"]] == [None, pytest.approx(1.03, abs=0.002), pytest.approx(1, abs=0.002)]
    joined, alone = maps_of(tmp_path / "out", 1)
    ratio = [np.median(maps.diffuse_albedo / moment(None).albedo) for maps in (joined, alone)]
    assert ratio[1] - ratio[0] == pytest.approx(0.03, abs=0.005)


def test_an_exposure_that_a_step_does_not_declare_is_said_and_another_subject_is_not():
    """The albedo of a step at half the light, and that of another scene with the same normals."""
    scene, other = moment(None), moment(None, other=True)
    random, everywhere = np.random.default_rng(4), np.ones((SIZE, SIZE), bool)

    def step(albedo):
        normal = scene.normal + np.radians(0.5) * random.normal(size=scene.normal.shape)
        return SurfaceMaps(camera=Camera(projection="orthographic", resolution=(SIZE, SIZE)), mask=everywhere,
                           normal=(normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32),
                           diffuse_albedo=(albedo * (1 + 0.01 * random.normal(size=albedo.shape))).astype(np.float32),
                           sigma=np.full((SIZE, SIZE), 0.7, np.float32))

    for albedo, factor in ((0.5 * scene.albedo, 0.5), (0.5 * other.albedo, None)):
        joiner = MapsJoiner(anchored=True)
        for before in range(2):
            assert "brightness_apart" not in joiner.join(step(scene.albedo))[1], before
        assert joiner.join(step(albedo))[1].get("brightness_apart") == (None if factor is None else pytest.approx(factor, rel=0.01))


@pytest.mark.long
def test_intensities_of_the_first_step_are_those_of_all(tmp_path):
    """Lights that are 10 % off in every step; in the last other lights are, which the images contradict."""
    random = np.random.default_rng(5)
    off, other = (np.exp(0.1 * random.normal(size=LIGHTS)) for _ in range(2))
    for step, strengths in enumerate((off, off, other)):
        write_step(tmp_path / "in" / f"step{step:02d}", moment(None), seed=step, noise=0.005, brightness=strengths)
    solve_sequence(request(tmp_path))
    used = [json.loads((tmp_path / "out" / f"step{step:02d}" / "alone" / "report.json").read_text())["found"]["light_intensities"]
            for step in range(3)]
    assert used[0]["used"] == "estimated" and used[1] == {"used": "those of the first step"}
    assert used[2]["used"] == "estimated" and used[2]["over_time"].startswith("its own: the images contradict")
    apart = [np.median(angles_degrees(next(maps_of(tmp_path / "out", step)).normal, moment(None).normal)) for step in range(3)]
    assert max(apart) < 1
    left = json.loads((tmp_path / "out" / "step00" / "alone" / "step.json").read_text())["left"]["lights"]["factor"]
    assert np.allclose(left / np.mean(left), off / off.mean(), rtol=0.02)
    assert solve_sequence(request(tmp_path)).kept == 3


@pytest.mark.long
def test_steps_that_are_done_are_not_solved_again(tmp_path, monkeypatch):
    write_sequence(tmp_path / "in", [None] * 3, noise=NOISE, size=24)
    solved, whole = [], steps.solve

    def counted(request, *arguments, **options):
        solved.append(request.capture.name)
        if len(solved) == 2:
            raise KeyboardInterrupt
        return whole(request, *arguments, **options)

    monkeypatch.setattr(steps, "solve", counted)
    with pytest.raises(KeyboardInterrupt):
        solve_sequence(request(tmp_path))
    assert solved == ["step00", "step01"] and "step00/alone/step.json" in files_in(tmp_path / "out")
    assert not any(name.startswith("step01") for name in files_in(tmp_path / "out"))
    assert solve_sequence(request(tmp_path)).kept == 1
    assert solved[2:] == ["step01", "step02"]
    first = {name: (tmp_path / "out" / name).read_bytes() for name in files_in(tmp_path / "out") if name.endswith(".exr")}
    assert solve_sequence(request(tmp_path)).kept == 3 and len(solved) == 4
    assert {name: (tmp_path / "out" / name).read_bytes() for name in first} == first
    write_step(tmp_path / "in" / "step01", moment(None, size=24), seed=77, noise=NOISE)
    assert solve_sequence(request(tmp_path)).kept == 2 and solved[4:] == ["step01"]
    assert solve_sequence(request(tmp_path, max_sigma=5.0)).kept == 0


def test_a_step_whose_results_are_not_its_own_is_done_again(tmp_path):
    """Joined maps stand where a run that joins nothing has its own; others are damaged or deleted."""
    maps, report = tmp_path / "maps.exr", tmp_path / "report.json"

    def work():
        maps.write_text("own")
        report.write_text("{}")
        return {"found": 1}

    assert steps.do_step(tmp_path, "content", work) == ({"found": 1}, False)
    assert steps.do_step(tmp_path, "content", work) == ({"found": 1}, True)
    for damage in (lambda: maps.write_text("joined"), maps.unlink, lambda: report.write_text("joined"), report.unlink):
        damage()
        assert steps.do_step(tmp_path, "content", work)[1] is False and maps.read_text() == "own"
    assert steps.do_step(tmp_path, "other", work)[1] is False


def test_what_is_refused(tmp_path, relit):
    write_sequence(tmp_path / "in", [None] * 2, size=16)
    with pytest.raises(RequestError, match=r"--lights refined: each step of a sequence"):
        solve_sequence(request(tmp_path, lights=LightsKnown.REFINED))
    relit("solve", tmp_path / "in", "--out", tmp_path / "in").refused("step00 in it is a capture of the sequence")
    outcome = relit("solve", tmp_path / "in" / "step00", "--out", tmp_path / "out", "--no-temporal")
    assert outcome.code == 2 and "--no-temporal:" in outcome.err and "is one capture" in outcome.err
    edit_manifest(tmp_path / "in" / "step01", camera={"projection": "orthographic", "resolution": [8, 16]})
    with pytest.raises(ManifestError, match=r"camera.resolution: is 8x16, that of step00 16x16"):
        solve_sequence(request(tmp_path))
    assert not (tmp_path / "out").exists()


@pytest.mark.long
def test_the_command_says_what_it_made_and_without_joining_each_step_is_a_solve(tmp_path, relit):
    write_sequence(tmp_path / "in", [None] * 2, size=16, noise=NOISE)
    out = relit("solve", tmp_path / "in", "--out", tmp_path / "joined", "--method", "lambert").well()
    assert "(2 steps, 0 done before)" in out and "taken at 24 a second" in out
    out = relit("solve", tmp_path / "in", "--no-temporal", "--out", tmp_path / "alone", "--method", "lambert").well()
    assert "taken at" not in out and "joined" not in out
    result = solve_sequence(request(tmp_path, temporal=False, frame_rate=12.5))
    assert files_in(tmp_path / "out" / "step01") == {"maps.exr", "report.json", "step.json"}
    assert result.joined is None and json.loads((tmp_path / "out" / "sequence.json").read_text())["frames_per_second"] == 12.5


@pytest.mark.long
def test_a_warning_of_many_steps_is_said_once(tmp_path):
    """A flat relief whose steps all warn of the height, each of another place."""
    write_sequence(tmp_path / "in", [8, 10, 12], noise=NOISE, size=24)
    result = solve_sequence(request(tmp_path, max_sigma=1e-3))
    said = [sentence for sentence in result.warnings if "no pixel is solved" in sentence]
    assert len(said) == 1 and said[0].startswith("step00: ") and said[0].endswith("(and 2 more of 3 steps, with other figures)")


def test_depth_at_rest_is_joined_and_what_moves_is_not(tmp_path):
    """A sphere that moves before a plane, under phases that a Gray code numbers.

    As for normals, but errors of whole periods, where a step cannot tell the period, are no noise and left out.
    """
    patterns = [*depths.BLACK_WHITE, *depths.phase_patterns("column", 16), *depths.gray_patterns("column", stripe=16)]
    scenes, out = [depths.make_scene(centre=(-0.1 + 0.04 * step, 0, -1.35)) for step in range(5)], tmp_path / "out"
    for step, scene in enumerate(scenes):
        depths.write_patterns(tmp_path / "in" / f"s{step}", scene, patterns, noise=0.01, seed=step)
    depth_sequence(DepthRequest(capture=tmp_path / "in", out=out, device="cpu", read_noise=0.01))
    changing = np.any([(np.abs(each.depth - scenes[0].depth) > 0) | each.shaded for each in scenes], axis=0)
    for step in range(1, len(scenes)):
        joined, alone = (DepthMaps.read(out / f"s{step}" / part / "depth.exr") for part in (".", "alone"))
        errors = [maps.depth - scenes[step].depth for maps in (joined, alone)]
        kept = alone.mask & (np.abs(errors[1]) < 0.02)
        rest, moves = kept & ~changing, kept & (np.abs(scenes[step].depth - scenes[step - 1].depth) > 0.03)
        assert rms(errors[0][rest]) < 1.1 * rms(errors[1][rest]) / np.sqrt(step + 1) + 0.0002
        assert rms(joined.sigma[rest]) > 0.95 * rms(errors[0][rest])
        assert rms(errors[0][moves]) <= 1.02 * rms(errors[1][moves])
    maps, cloud = DepthMaps.read(out / "s4" / "depth.exr"), read_ply(out / "s4" / "points.ply")
    cols, rows = (np.floor(place).astype(int) for place in maps.camera.image_coordinates(cloud.points))
    np.testing.assert_allclose(-cloud.points[:, 2], maps.depth[rows, cols], rtol=1e-5)
    assert maps.projector_u is None and len(cloud.points) == maps.mask.sum()
