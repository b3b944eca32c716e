"""relit calibrate rig, on images of a ball and a card that are made of the DMX values of the cues, by a stage that the rig's file does not
know: other colours, powers and responses, ambient light, noise and a ball with a little gloss."""

import json
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from stage.formats import exr
from stage.rig.chart import read_chart
from stage.rig.patch import light_at_drive
from stage.rig.rig import read_rig
from tests.reference.balls import lambertian, mirror_of_far, render
from tests.scenes.captures import write_exr, write_manifest
from tests.scenes.rigs import write_rig

NAMES = ("red", "green", "blue", "amber", "white")
SIDE = {"width": 64, "height": 56}
BALL = {"centre": np.array([0.0017, -0.0008, 0.0]), "radius": 0.022, "pixel_size": 0.001, **SIDE}
CIRCLE = "33.7,28.8,22"
ALBEDO = 0.18
LEVELS = 6


class Stage(NamedTuple):
    """What the lamps really do."""

    directions: np.ndarray  # [lamps, 3]
    irradiance: np.ndarray  # [lamps, primaries, 3]
    gamma: np.ndarray  # [lamps, primaries]
    dead: np.ndarray  # [lamps, primaries]

    def light(self, lamp: int, primary: int, drive):
        """The light of a primary at a drive, a fraction of full."""
        dead = self.dead[lamp, primary]
        return np.clip((np.asarray(drive) - dead) / (1 - dead), 0, 1) ** self.gamma[lamp, primary]


def make_stage(lamps: int, seed: int) -> Stage:
    random = np.random.default_rng(seed)
    directions = random.normal(size=(lamps, 3)) + [0, 0, 1.2]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    irradiance = np.array([[2.1, 0.1, 0.02], [0.1, 1.7, 0.2], [0.05, 0.1, 2.6], [1.5, 0.7, 0.01], [1.1, 1.2, 0.9]])
    irradiance = irradiance * random.uniform(0.8, 1.2, (lamps, 5, 3))
    irradiance[1:2] *= 0.5
    gamma = np.tile([1.0, 1.6, 2.2, 0.8, 2.6], (lamps, 1))
    return Stage(directions, irradiance, gamma, np.tile([0.0, 0.04, 0.09, 0.0, 0.0], (lamps, 1)))


def shoot(folder: Path, stage: Stage, unit: list[np.ndarray], cues: dict, *, noise: float = 0.003, clip: float = np.inf,
          **manifest) -> Path:
    """A capture of the frames of cues, with ambient light on top.

    `unit` is the image [h, w, primaries or 1, 3 or 1] of each lamp at an irradiance of 1.
    """
    folder.mkdir()
    random = np.random.default_rng(4)
    ambient = 0.02 + 0.01 * np.linspace(0, 1, unit[0][..., 0, 0].size).reshape(unit[0].shape[:2])[..., None] * [1, 0.8, 0.5]
    for number, frame in enumerate(cues["frames"]):
        image = ambient.copy()
        values = np.array(frame["dmx"][0]["values"])
        for lamp in range(len(stage.directions)):
            for primary in range(5):
                at = 10 * lamp + 2 * primary
                drive = (256 * values[at] + values[at + 1]) / 65535
                seen = unit[lamp][..., primary % unit[lamp].shape[2], :]
                image += seen * stage.irradiance[lamp, primary] * stage.light(lamp, primary, drive)
        image += random.normal(size=image.shape) * noise * max(each.max() for each in unit)
        write_exr(folder / f"{number:03d}.exr", np.minimum(np.maximum(image, 0), clip))
    light = {"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}
    write_manifest(folder, {"schema": "relit.capture/1", "name": "lamps", "color_space": "lin_rec709_scene", "camera": {
        "projection": "orthographic", "resolution": [SIDE["width"], SIDE["height"]], "pixel_size_m": 0.001},
        "frames": [{"image": f"{number:03d}.exr", "light": light} for number in range(len(cues["frames"]))], **manifest})
    return folder


def nominal(tmp_path: Path, stage: Stage) -> Path:
    """The rig as its owner knows it, before it is measured."""
    write_rig(tmp_path / "rig.json", stage.directions, dict.fromkeys(NAMES, (1.0, 1.0, 1.0)), bits=16)
    return tmp_path / "rig.json"


def swept(relit, rig: Path, *options) -> tuple[dict, Path]:
    folder = rig.parent / "sweep"
    relit.done("rig", "sweep", rig, "--out", folder, *options)
    return json.loads((folder / "cues.json").read_text()), folder / "cues.csv"


def grey_ball(stage: Stage) -> list[np.ndarray]:
    """The ball under each lamp, with a broad highlight of a third of its brightness."""
    return [render(lambertian(direction, albedo=ALBEDO, highlight=0.02), samples=4, **BALL)[0][..., None, None]
            for direction in stage.directions]


def check(rig, stage: Stage, report: dict, *, within: float) -> None:
    for lamp, primaries in enumerate(rig.lights):
        for place, primary in enumerate(primaries.primaries):
            truth, entry = stage.irradiance[lamp, place], report["primaries"][5 * lamp + place]
            error = np.abs(np.array(primary.irradiance) - truth)
            assert (error < within * truth.max()).all() and (error < 4 * np.array(entry["sigma"]) + 1e-3 * truth.max()).all()
            drives = np.linspace(0, 1, 201)
            assert np.abs(light_at_drive(drives, primary) - stage.light(lamp, place, drives)).max() < 0.02  # 6 levels, the noise below
            assert entry["curve"] == ("linear" if place == 0 else f"{LEVELS} levels")


def test_a_grey_ball_measures_colours_powers_and_responses(relit, tmp_path):
    """The gloss adds 1 to 2 % to what a matt ball sends; lamp 1 has half the power of the others."""
    stage = make_stage(3, 8)
    rig = nominal(tmp_path, stage)
    cues, table = swept(relit, rig, "--levels", LEVELS)
    assert len(cues["frames"]) == 1 + 3 * 5 * LEVELS
    capture = shoot(tmp_path / "capture", stage, grey_ball(stage), cues, assumed=["the images are linear"])
    out = tmp_path / "measured.json"
    said = relit.done("calibrate", "rig", capture, rig, "--table", table, "--ball", CIRCLE, "--albedo", ALBEDO, "--out", out)
    measured = read_rig(out)
    report = json.loads((tmp_path / "calibration.json").read_text())["rig"]
    assert (report["measured"], report["dark_frames"], report["irradiance_scale"]) == (15, 1, "absolute")
    assert report["warnings"] == ["the images are linear"] and "warning  the images are linear" in said.out
    check(measured, stage, report, within=0.03)
    given = np.array([[primary.irradiance for primary in lamp.primaries] for lamp in measured.lights])
    assert given[1].sum() / given[[0, 2]].sum(axis=(1, 2)).mean() == pytest.approx(
        stage.irradiance[1].sum() / stage.irradiance[[0, 2]].sum(axis=(1, 2)).mean(), rel=0.02)


@pytest.mark.long
def test_a_mirror_ball_and_a_card_measure_the_same(relit, tmp_path):
    """The lamps are lobes of 3 degrees; a card that is tilted away by 25 degrees sees those that its normal is near to."""
    stage = make_stage(2, 21)
    directions = np.array([[0.3, 0.2, 0.93], [-0.5, 0.1, 0.86]])
    stage = stage._replace(directions=directions / np.linalg.norm(directions, axis=1, keepdims=True))
    rig = nominal(tmp_path, stage)
    cues, table = swept(relit, rig, "--levels", LEVELS)
    solid = 2 * np.pi * np.radians(3) ** 2  # of the lobe
    mirror = [render(mirror_of_far(direction, degrees=3), samples=8, **BALL)[0][..., None, None] * 0.6 / solid
              for direction in stage.directions]
    normal = np.array([np.sin(np.radians(25)), 0, np.cos(np.radians(25))])
    card = [np.full((SIDE["height"], SIDE["width"], 1, 1), ALBEDO / np.pi * (normal @ direction)) for direction in stage.directions]
    for name, unit, reflects, options in (("mirror-ball", mirror, 0.6, ("--ball", CIRCLE)), ("card", card, ALBEDO, (
            "--region", "5,6,40,30", "--card-normal", ",".join(map(str, normal))))):
        capture = shoot(tmp_path / name, stage, unit, cues, noise=0.002)
        relit.done("calibrate", "rig", capture, rig, "--table", table, "--target", name, *options, "--albedo", reflects,
                   "--out", tmp_path / "measured.json")
        report = json.loads((tmp_path / "calibration.json").read_text())["rig"]
        check(read_rig(tmp_path / "measured.json"), stage, report, within=0.03)


CENTRES = np.array([[8.0, 10.0], [55.0, 7.0], [57.0, 45.0], [6.0, 42.0]])
"""Pixels of the corner patches of a chart that lies askew, in perspective."""
CORNERS = ",".join(map(str, CENTRES.ravel()))


def chart_patches(folder: Path) -> tuple[Path, np.ndarray, np.ndarray]:
    """A table of six neutral and eighteen coloured patches, their reflectances [24, 3], and the patch that each pixel shows, by cv2."""
    random = np.random.default_rng(5)
    reflectance = random.uniform(0.05, 0.8, (24, 3))
    reflectance[18:] = np.geomspace(0.9, 0.03, 6)[:, None]
    lines = [f"p{number},{','.join(map(str, each))}" for number, each in enumerate(reflectance)]
    (folder / "patches.csv").write_text("\n".join(["name,r,g,b", *lines]))
    form = cv2.getPerspectiveTransform(CENTRES.astype(np.float32), np.float32([[0, 0], [5, 0], [5, 3], [0, 3]]))
    v, u = np.mgrid[: SIDE["height"], : SIDE["width"]]
    place = cv2.perspectiveTransform(np.stack([u, v], axis=-1).astype(np.float64).reshape(-1, 1, 2), form).reshape(*u.shape, 2)
    column, row = np.clip(np.rint(place).astype(int), 0, (5, 3)).transpose(2, 0, 1)
    return folder / "patches.csv", reflectance, row * 6 + column


@pytest.mark.long
def test_a_chart_measures_lamps_and_how_the_camera_sees_it_under_each(relit, tmp_path):
    """Coloured patches reflect other parts of narrow primaries than their reflectances say; lamp 1 has half the power of the others."""
    stage = make_stage(3, 30)
    directions = np.array([[0.3, 0.2, 0.93], [-0.5, 0.1, 0.86], [0.1, -0.4, 0.9]])
    stage = stage._replace(directions=directions / np.linalg.norm(directions, axis=1, keepdims=True))
    rig = nominal(tmp_path, stage)
    cues, table = swept(relit, rig, "--levels", LEVELS)
    reflectances, reflectance, patch = chart_patches(tmp_path)
    narrow = np.random.default_rng(6).uniform(0.6, 1.4, (5, 24, 3)) * reflectance
    narrow[:, 18:] = reflectance[18:]
    unit = [narrow[:, patch].transpose(1, 2, 0, 3) * direction[2] / np.pi for direction in stage.directions]
    capture = shoot(tmp_path / "chart", stage, unit, cues, noise=0.001)
    options = ("--table", table, "--target", "chart", "--out", tmp_path / "measured.json")
    relit.done("calibrate", "rig", capture, rig, *options, "--corners", CORNERS, "--reflectances", reflectances)
    report = json.loads((tmp_path / "calibration.json").read_text())["rig"]
    assert (report["irradiance_scale"], report["patches"]) == ("absolute", 24)
    check(read_rig(tmp_path / "measured.json"), stage, report, within=0.01)  # of noise 0.3 % of a patch, in some 100 pixels

    chart = json.loads((tmp_path / "chart.json").read_text())
    assert chart["target"] == reflectance.tolist()
    for place, name in enumerate(NAMES):
        mean = stage.irradiance[:, place].mean(axis=0)
        assert np.abs(np.array(chart["primaries"][name]) - narrow[place] * mean).max() < 0.01 * mean.max()
    # a rig that gives the light that the mean of its lamps gives takes a lamp of half the power at twice the level
    half, whole = (read_chart(tmp_path / "chart.json").of(read_rig(tmp_path / "measured.json").lights[lamp]) for lamp in (1, 0))
    assert half.sum() / whole.sum() == pytest.approx(stage.irradiance[1].sum() / stage.irradiance[0].sum(), rel=0.1)  # colours differ


def test_charts_that_cannot_be_measured(relit, tmp_path):
    stage = make_stage(1, 30)._replace(directions=np.array([[0.0, 0.0, 1.0]]))
    rig = nominal(tmp_path, stage)
    cues, table = swept(relit, rig, "--levels", 2)
    path, _, patch = chart_patches(tmp_path)
    capture = shoot(tmp_path / "chart", stage, [np.where(patch < 6, 0.4, 0.1)[..., None, None]], cues, clip=0.3)
    command = ("calibrate", "rig", capture, rig, "--table", table, "--target", "chart", "--out", tmp_path / "measured.json")
    away = CORNERS.replace("57.0", "157.0")
    for words, options in (("--corners", ("--reflectances", path)), ("for --target chart", ("--target", "card", "--corners", CORNERS)),
                           ("lead out", ("--reflectances", path, "--corners", away)),
                           ("on a line", ("--reflectances", path, "--corners", "1,1,2,2,3,3,9,1")),
                           ("--grid 5,4", ("--reflectances", path, "--corners", CORNERS, "--grid", "5,4")),
                           ("misses Lambert's law", ("--reflectances", path, "--corners", CORNERS))):
        assert words in relit.refused(*command, *options)
    path.write_text(path.read_text().replace("p7,", "p7,2"))
    assert "line 9" in relit.refused(*command, "--reflectances", path, "--corners", CORNERS)
    assert not (tmp_path / "measured.json").exists() and not (tmp_path / "chart.json").exists()


def test_doubtful_images_are_refused_by_name(relit, tmp_path):
    stage = make_stage(2, 5)
    rig = nominal(tmp_path, stage)
    cues, table = swept(relit, rig, "--levels", 3, "--light", "L000")
    unit = grey_ball(stage)
    ask = ("--ball", CIRCLE, "--albedo", ALBEDO, "--out", tmp_path / "measured.json")
    lines = table.read_text().splitlines()
    capture = shoot(tmp_path / "capture", stage, unit, cues)

    def refused(words: str, content: list[str] = lines, options: tuple = ask, **changes) -> None:
        folder = shoot(tmp_path / f"capture {words[:4]}", stage, changes.pop("unit", unit), cues, **changes) if changes else capture
        (tmp_path / "table.csv").write_text("\n".join(content))
        sentence = relit.refused("calibrate", "rig", folder, rig, "--table", tmp_path / "table.csv", *options)
        assert words in sentence
        assert not (tmp_path / "measured.json").exists() and not (tmp_path / "calibration.json").exists()

    refused("red of L000: 003.exr: ", clip=0.05, saturation=0.05)
    refused("the ball is lit from", unit=unit[::-1])  # the table says L000, L001 shines
    refused("no frame of it at level 1", [line for line in lines if not line.startswith("4,")])
    refused("is no primary of the rig", [*lines, "2,L009,red,1"])
    refused("several primaries above 0", [*lines, "2,L001,red,1"])
    refused("line 18: level: is 1.2", [*lines, "2,L000,red,1.2"])
    refused("must be an image of", [*lines, "99,L000,red,1"])
    refused("has no column primary", ["frame,light,level"])
    refused("darker at the level", [*lines[:2], *(f"{index + 2},L000,red,{level}" for index, level in enumerate((1, 0.7, 0.3)))])
    refused("--albedo: is missing", options=("--ball", CIRCLE, "--out", tmp_path / "measured.json"))
    refused("--target card: give its place", options=("--target", "card", *ask))


@pytest.mark.long
def test_copies_and_encoded_images_are_said(relit, tmp_path):
    """Images that are gamma-encoded and declared linear gave twice the irradiance, and a copy of a lower level three quarters."""
    stage = make_stage(1, 8)
    rig = nominal(tmp_path, stage)
    cues, table = swept(relit, rig, "--levels", 4)
    capture = shoot(tmp_path / "capture", stage, grey_ball(stage), cues)
    ask = ("--ball", CIRCLE, "--albedo", ALBEDO, "--out", tmp_path / "measured.json")
    command = ("calibrate", "rig", capture, rig, "--table", table, *ask)
    relit.done(*command)
    report = json.loads((tmp_path / "calibration.json").read_text())["rig"]
    assert report["flagged"] == 0
    (tmp_path / "two.csv").write_text("\n".join(["frame,light,primary,level", "1,L000,red,0", "4,L000,red,0.75",
                                                    "9,L000,red,1"]))  # frame 9 shows green
    relit.done("calibrate", "rig", capture, rig, "--table", tmp_path / "two.csv", *ask)
    report = json.loads((tmp_path / "calibration.json").read_text())["rig"]
    assert any("its colour changes with the level" in flag for flag in report["primaries"][0]["flags"])
    full = (capture / "004.exr").read_bytes()
    (capture / "004.exr").write_bytes((capture / "003.exr").read_bytes())
    assert "red of L000: 004.exr and 003.exr are the same image, at the levels 1 and 0.75" in relit.refused(*command)
    (capture / "004.exr").write_bytes(full)
    for path in capture.glob("*.exr"):
        channels, _ = exr.read(path)
        write_exr(path, np.maximum(np.stack([channels[name] for name in "RGB"], axis=-1), 0) ** (1 / 2.2))
    relit.done(*command)
    report = json.loads((tmp_path / "calibration.json").read_text())["rig"]
    assert report["flagged"] == 5 and all("lin_rec709_scene is declared, but as" in each["flags"][0] for each in report["primaries"])
