"""A performance, frames under lights that repeat a plan: cut into a sequence, solved aligned, and relit; and what does not fit is named."""

import shutil

import numpy as np
import pytest

from stage.capture.manifest import read_manifest
from stage.capture.sequence import read_sequence
from stage.formats import exr
from stage.results.maps import SurfaceMaps
from tests.scenes.captures import angles_degrees, files_in, rgb, ring, write_exr, write_image
from tests.scenes.moving import RADIUS, Subject
from tests.scenes.patched_rigs import write_plan
from tests.scenes.rigs import write_rig
from tests.scenes.video import write_video

LAMPS, EVERY, PERIOD, STEPS = 8, 4, 10, 4
"""A period is T LLLL T LLLL, and a tracking frame closes the last."""
NOISE = 0.01
"""Standard deviation of the noise, as a part of the brightest albedo under one lamp."""
GLIDING = Subject(shift_px=(0.43, -0.31))
STILL = Subject()
ORDER = ["full", 0, 1, 2, 3, "full", 4, 5, 6, 7]


def rig(folder, lamps=LAMPS):
    write_rig(folder / "rig.json", ring(lamps), {"white": (np.pi,) * 3})
    return folder / "rig.json"


def frame(subject, time, light):
    """[rows, cols, 3]: the subject before a textured wall at rest, under one lamp, all at half their light, or none."""
    directions = ring(LAMPS)
    if light == "off":
        return np.zeros((subject.size, subject.size, 3))
    if light == "full":
        return 0.5 * sum(frame(subject, time, lamp) for lamp in range(LAMPS))
    wall = STILL._replace(size=subject.size).albedo(200)[..., None] * np.maximum(directions[light][2], 0)
    return np.where(subject.mask(time)[..., None], subject.lit(time, directions[light]), wall)


def shoot(folder, subject, *, count=PERIOD * STEPS + 1, noise=NOISE, first=0, order=ORDER):
    """Write the frames of a performance whose subject is in the middle of the image when the third period begins."""
    random = np.random.default_rng(3)
    for number in range(count):
        image = frame(subject, number - 2 * PERIOD, order[(number + first) % len(order)])
        write_exr(folder / f"take_{number}.exr", np.maximum(image + noise * random.standard_normal(image.shape), 0))
    return folder


def imported(relit, source, target, *options, sequences=({"take": "olat"},), tracking_every=EVERY, lamps=LAMPS):
    """Run the import with the plan of these sequences beside the target."""
    folder = target.parent
    period = write_plan(folder, *sequences, tracking_every=tracking_every)
    return relit("import", "interleaved", source, target, "--period", period, "--rig", rig(folder, lamps), *options)


@pytest.fixture(scope="module")
def gliding(tmp_path_factory):
    return shoot(tmp_path_factory.mktemp("gliding"), GLIDING._replace(size=48), noise=0.002)


def test_each_period_is_a_step_and_the_next_tracking_frame_closes_it(relit, tmp_path, gliding):
    out = imported(relit, gliding, tmp_path / "walk", "--frame-rate", "100").well()
    sequence = read_sequence(tmp_path / "walk")
    assert sequence.frames_per_second == 10 and [step.name for step in sequence.steps] == ["0001", "0002", "0003", "0004"]
    # of T LLLL T LLLL T the middle tracking frame is that to whose time the others are taken
    assert [step.time_s for step in sequence.steps] == pytest.approx([0.05, 0.15, 0.25, 0.35])
    for number, step in enumerate(sequence.steps):
        manifest = read_manifest(step.folder / "capture.json")
        assert [each.image for each in manifest.frames] == [f"take_{PERIOD * number + place}.exr" for place in range(PERIOD + 1)]
        assert [each.light.type for each in manifest.frames] == ["full", *["distant"] * 4] * 2 + ["full"]
        assert np.allclose([each.light.direction for each in manifest.frames if each.light.type == "distant"], ring(LAMPS))
        assert (step.folder / "take_20.exr").exists() == (number in (1, 2))
    assert f"relit solve {tmp_path / 'walk'} --align --out walk-maps" in out
    assert {path.name for path in tmp_path.iterdir()} == {"walk", "plan.json", "rig.json"}


@pytest.mark.long
def test_normals_of_a_moving_subject_are_those_of_one_at_rest(relit, tmp_path):
    """It moves by 5.3 pixels a period. Solved without the mean over time, from which what is at rest alone gains. At 1 % noise the median
    error is 0.75 degrees, at rest 0.93: frames between pixels are means of pixels, which have less noise."""
    errors = {}
    for name, subject in (("still", STILL), ("moving", GLIDING)):
        imported(relit, shoot(tmp_path / name, subject), tmp_path / f"{name}-in").well()
        relit.done("solve", tmp_path / f"{name}-in", "--align", "--no-temporal", "--method", "lambert", "--out", tmp_path / f"{name}-out")
        found = []
        for number in range(STEPS):
            maps = SurfaceMaps.read(tmp_path / f"{name}-out" / f"{number + 1:04d}" / "maps.exr", unsure=True)
            time = PERIOD * number + 5 - 2 * PERIOD  # of the middle tracking frame
            inner = (np.hypot(*subject.body(time)) < RADIUS * subject.size - 4) & maps.estimated
            found.append(angles_degrees(maps.normal, subject.normal(time))[inner])
            assert inner.sum() > 0.98 * (np.hypot(*subject.body(time)) < RADIUS * subject.size - 4).sum()
        errors[name] = np.concatenate(found)
    assert np.median(errors["moving"]) < 1.3 * np.median(errors["still"])
    assert np.percentile(errors["moving"], 95) < 1.3 * np.percentile(errors["still"], 95)


@pytest.mark.long
def test_what_is_at_rest_does_not_flicker_when_relit(relit, tmp_path):
    imported(relit, shoot(tmp_path / "frames", GLIDING), tmp_path / "walk").well()
    write_exr(tmp_path / "even.exr", np.ones((8, 16, 3)))
    relit("relight", tmp_path / "walk", "--environment", tmp_path / "even.exr", "--align", "--out", tmp_path / "relit.#.exr").well()
    shown = np.stack([exr.read(tmp_path / f"relit.{number + 1}.exr")[0]["G"].astype(np.float64) for number in range(STEPS)])
    rest = np.ones(shown.shape[1:], bool)
    for number in range(PERIOD * STEPS + 1):
        rest &= np.hypot(*GLIDING.body(number - 2 * PERIOD)) > RADIUS * GLIDING.size + 10
    assert rest.mean() > 0.1
    relative = shown[:, rest] / shown[:, rest].mean(axis=0)
    wall = STILL.albedo(200)[rest]
    assert np.sqrt((relative.var(axis=0, ddof=1)).mean()) < (NOISE / wall).mean()  # of a pixel, below the noise of one image
    assert np.ptp(relative.mean(axis=1)) < NOISE / 10  # of all of them together: no pumping


@pytest.mark.long
def test_a_video_is_cut_into_steps(relit, tmp_path):
    source = shoot(tmp_path / "frames", GLIDING._replace(size=48), noise=0)
    frames = (rgb(source / f"take_{number}.exr")[..., ::-1] for number in range(PERIOD * STEPS + 1))
    write_video(tmp_path / "take.avi", (np.rint(255 * np.clip(frame / 4, 0, 1) ** (1 / 2.2)).astype(np.uint8) for frame in frames),
                codec="FFV1", rate=120)
    out = imported(relit, tmp_path / "take.avi", tmp_path / "walk").well()
    assert "41 of its frames" in out or "41 of 41 frames" in out
    sequence = read_sequence(tmp_path / "walk")
    assert sequence.frames_per_second == 12 and len(sequence.steps) == STEPS
    manifest = read_manifest(sequence.steps[3].folder / "capture.json")
    assert manifest.color_space == "srgb_texture" and manifest.frames[0].image == "take_000030.png"
    imported(relit, tmp_path / "take.avi", tmp_path / "part", "--frames", "10-30").well()
    assert len(read_sequence(tmp_path / "part").steps) == 2
    words = imported(relit, tmp_path / "take.avi", tmp_path / "none", "--frames", "0-37").refused("ends within a period, after 38 frames")
    assert "use the 3 whole periods, --frames 0-30" in words and not (tmp_path / "none").exists()


def renumbered(folder, keep):
    """Leave frames out, or repeat them, as a camera does that loses some."""
    kept = [(folder / f"take_{number}.exr").read_bytes() for number in keep]
    for path in folder.iterdir():
        path.unlink()
    for number, content in enumerate(kept):
        (folder / f"take_{number}.exr").write_bytes(content)


EACH = list(range(PERIOD * STEPS + 1))
FAULTS = {
    "middle": (lambda folder: renumbered(folder, EACH[:-4]), "frames: ends within a period, after 37 frames: a period of"),
    "few": (lambda folder: renumbered(folder, EACH[:7]), "frames: has 7 frames, and a period of"),
    "lost": (lambda folder: renumbered(folder, [*EACH[:23], *EACH[24:], 1]), "take_25.exr: should be a tracking frame, and does not"),
    "doubled": (lambda folder: renumbered(folder, [*EACH[:17], *EACH[16:-1]]), "take_25.exr: should be a tracking frame, and does not"),
    "begins late": (lambda folder: renumbered(folder, [*EACH[3:], 1, 2, 3]), "take_0.exr: should be a tracking frame, and does not"),
    "dark": (lambda folder: write_exr(folder / "take_20.exr", np.full((48, 48, 3), 1e-3)),
             "take_20.exr: should be a tracking frame, and has"),
    "size": (lambda folder: write_exr(folder / "take_7.exr", np.ones((48, 40, 3))), "take_7.exr: has 40x48 pixels, take_0.exr 48x48"),
    "two masks": (lambda folder: [write_image(folder / f"mask{n}.png", np.ones((48, 48), np.uint8)) for n in (1, 2)],
                  "mask1.png and mask2.png both look like the mask"),
    "damaged": (lambda folder: (folder / "take_9.exr").write_bytes(b"v/1"), "take_9.exr"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_frames_that_do_not_repeat_the_plan_are_named(relit, tmp_path, gliding, fault):
    shutil.copytree(gliding, tmp_path / "frames")
    change, words = FAULTS[fault]
    change(tmp_path / "frames")
    imported(relit, tmp_path / "frames", tmp_path / "walk").refused(words)
    assert {path.name for path in tmp_path.iterdir()} == {"frames", "plan.json", "rig.json"}


@pytest.mark.parametrize(("keep", "words"), [
    ([*EACH[:23], *EACH[24:], 1], "take_23.exr: is lit as take_14.exr, 9 frames before it, and a period has 10"),
    ([*EACH[:17], *EACH[16:-1]], "take_17.exr: is lit as take_6.exr, 11 frames before it"),
], ids=["lost", "doubled"])
def test_of_a_subject_that_hardly_moves_the_very_frame_is_named(relit, tmp_path, keep, words):
    """Without tracking frames too."""
    shoot(tmp_path / "frames", Subject(size=48, shift_px=(0.02, 0.0)), noise=0.002, order=["off", "off", *range(LAMPS)])
    renumbered(tmp_path / "frames", keep)
    imported(relit, tmp_path / "frames", tmp_path / "walk", "--frames", "0-39", tracking_every=None,
             sequences=[{"take": "dark", "count": 2}, {"take": "olat"}]).refused(words)


@pytest.mark.parametrize("lamps", [9, 7])
def test_another_period_than_that_of_the_frames_is_named(relit, tmp_path, gliding, lamps):
    """Frames that happen to be as many as whole periods of a plan with another number of lamps."""
    shutil.copytree(gliding, tmp_path / "frames")
    renumbered(tmp_path / "frames", EACH[:3 * (lamps + {9: 3, 7: 2}[lamps]) + 1])
    outcome = imported(relit, tmp_path / "frames", tmp_path / "walk", lamps=lamps)
    assert outcome.code == 2 and ("10 frames before it" in outcome.err or "should be a tracking frame" in outcome.err), outcome
    assert not (tmp_path / "walk").exists()


def test_plans_that_cannot_repeat_and_folders_that_are_there_are_refused(relit, tmp_path, gliding):
    def run(period, *options, target=tmp_path / "walk"):
        return relit("import", "interleaved", gliding, *([target] if target else []), "--period", period, "--rig", rig(tmp_path), *options)

    run("polarised").refused("waits for a person")
    run("olat", target=None).refused("DST is missing")
    run("gray").refused("give the pixels of the projector")
    run(write_plan(tmp_path, {"take": "olat"}, {"take": "flat"})).refused("flat is an image of something else")
    run("olat", "--frames", "0-90").refused("has 41 frames, 0 to 40, and --frames asks for 0-90")
    run("olat", "--frames", "all").refused("--frames all: give first, last and step")
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk" / "notes.txt").write_text("mine")
    before = files_in(tmp_path)
    imported(relit, gliding, tmp_path / "walk").refused("is there already: give another folder")
    assert set(files_in(tmp_path)) == {*before, "plan.json"}


def test_gradients_dark_and_patterns_are_frames_of_a_period(relit, tmp_path):
    """Without tracking frames nothing closes a period."""
    def run(frames):
        return imported(relit, tmp_path / "frames", tmp_path / "walk", "--projector", "64x32", "--frames", frames, tracking_every=None,
                        sequences=[{"take": "dark"}, {"take": "gradients"}, {"take": "patterns", "code": "phase"}])

    random = np.random.default_rng(0)
    for count in range(1, 60):  # the number of images of the code with its default options is that of relit patterns
        write_exr(tmp_path / "frames" / f"{count}.exr", random.uniform(0.1, 1, (32, 32, 3)))
    length = int(run("0-0").refused("has 1 frames, and a period of").split("has ")[-1].split()[0])
    run(f"0-{length - 1}").well()
    manifest = read_manifest(tmp_path / "walk" / "0001" / "capture.json")
    kinds = [frame.light.type if frame.light else frame.pattern.code for frame in manifest.frames]
    assert kinds[:8] == ["off", *["gradient"] * 7] and len(kinds) == length and "phase" in kinds[8:]
