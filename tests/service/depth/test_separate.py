"""relit separate: known direct and global light come back, what cannot be separated is one sentence, and the path-traced rig agrees."""

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks.rig import read_truth
from service.depth.separate import separate
from service.requests.depth import SeparateRequest
from stage.capture.capture import Capture
from stage.formats import exr
from stage.results.depth_normals import depth_normals
from tests.scenes.captures import edit_manifest, files_in, write_exr, write_image, write_images, write_manifest

RIG = Path(__file__).parents[3] / "samples" / "rig"
ROWS, COLS = 12, 20
BLACK, WHITE = {"code": "black"}, {"code": "white"}


def known() -> tuple[np.ndarray, np.ndarray]:
    """[rows, cols, 3] direct and global light; the left columns see no direct light."""
    rng = np.random.default_rng(0)
    direct, indirect = rng.uniform(0.1, 0.5, (ROWS, COLS, 3)), rng.uniform(0.05, 0.3, (ROWS, COLS, 3))
    direct[:, :4] = 0
    return direct, indirect


def phases(period: float = 16, *, axis: str = "column", steps: int = 4) -> list[dict]:
    return [{"code": "phase", "axis": axis, "period_px": period, "step": step, "steps": steps} for step in range(steps)]


def write(folder: Path, patterns: list[dict], *, leak: float = 0.0, ambient: float = 0.0, gamma: float = 1.0, **changes) -> Path:
    """A capture whose pixels see places spread over the projector, in EXR."""
    direct, indirect = known()
    place = np.random.default_rng(1).uniform(100, 900, (2, ROWS, COLS))
    images = []
    for pattern in patterns:
        if pattern["code"] == "phase":
            turns = place[int(pattern["axis"] == "row")] / pattern["period_px"] - pattern["step"] / pattern["steps"]
            level = ((1 + np.cos(2 * np.pi * turns[..., None])) / 2) ** gamma
            mean = (((1 + np.cos(np.arange(400) / 200 * np.pi)) / 2) ** gamma).mean()
        else:
            level = mean = float(pattern["code"] == "white")
        images.append(ambient + direct * (leak + (1 - leak) * level) + indirect * (leak + (1 - leak) * mean))
    frames = write_images(folder, images, [{"pattern": pattern} for pattern in patterns], "{}.exr")
    camera = {"projection": "orthographic", "resolution": [COLS, ROWS]}
    write_manifest(folder, {"schema": "relit.capture/1", "name": "wax", "camera": camera, "frames": frames, **changes})
    return folder


def solve(relit, folder: Path, *arguments):
    """Direct, global, status and the report of a run."""
    relit.done("separate", folder, "--out", folder / "out", "--device", "cpu", *arguments)
    channels, metadata = exr.read(folder / "out" / "separation.exr")
    direct, indirect = (np.stack([channels[f"{name}.{c}"] for c in "RGB"], axis=-1) for name in ("direct", "global"))
    return direct, indirect, channels, metadata, json.loads((folder / "out" / "report.json").read_text())


@pytest.mark.parametrize("patterns", [[*phases(), BLACK, WHITE], [*phases(), *phases(axis="row"), BLACK],
                                      [WHITE, *phases(40), *phases(11.5, steps=3), BLACK]], ids=["one", "both axes", "two periods"])
def test_known_light_comes_back(relit, tmp_path, patterns):
    write(tmp_path, patterns, leak=0.04, ambient=0.1)
    direct, indirect, channels, _, report = solve(relit, tmp_path)
    truth = known()
    np.testing.assert_allclose(direct, 0.96 * truth[0], atol=2e-6)  # of white minus black
    np.testing.assert_allclose(indirect, 0.96 * truth[1], atol=2e-6)
    assert (channels["mask.Y"] == 1).all() and (channels["status.Y"] == 1).all()
    assert report["found"]["period_px"] == (11.5 if patterns[0] == WHITE else 16)
    assert report["found"]["ambient"] == "black frame" and report["pixels"] == {"mask": ROWS * COLS, "ok": ROWS * COLS, "saturated": 0}
    if WHITE in patterns:
        assert report["found"]["sum_over_white"] == pytest.approx(1, abs=1e-5)


def test_light_of_several_exposures_comes_back(relit, tmp_path):
    """The long exposure clips the bright half of the pixels, the short one has a fortieth of its noise in the dark half: each reading
    has noise of a thousandth of full scale, and the error of the parts is that of the sum of the exposures that a pixel takes."""
    write(tmp_path, [*phases(), WHITE, BLACK])
    frames, random = [], np.random.default_rng(4)
    dim = np.where(np.arange(ROWS)[:, None, None] < ROWS // 2, 1.0, 0.02)
    for frame in json.loads((tmp_path / "capture.json").read_text())["frames"]:
        image, _ = exr.read(tmp_path / frame["image"])
        image = np.stack([image[channel] for channel in "RGB"], axis=-1) * dim
        for time in (0.5, 20.0):
            name = f"{time:g}_{frame['image']}"
            recorded = image * time + 0.05 + random.normal(0, 0.001, image.shape)  # on a pedestal, which the dark image takes away
            write_exr(tmp_path / name, np.minimum(recorded, 1.0))
            frames.append({"image": name, "pattern": frame["pattern"], "exposure_s": time})
    write_exr(tmp_path / "dark.exr", np.full((ROWS, COLS, 3), 0.05))
    edit_manifest(tmp_path, frames=frames, saturation=0.99, dark="dark.exr")
    direct, indirect, channels, _, report = solve(relit, tmp_path)
    truth = known()
    assert (channels["mask.Y"] == 1).all() and report["found"]["exposures_s"] == [0.5, 20.0]
    assert report["found"]["pixels_of_exposures"] == [ROWS * COLS, ROWS * COLS // 2]
    for rows, sigma in ((slice(0, ROWS // 2), 0.001 / 0.5), (slice(ROWS // 2, ROWS), 0.001 * 2**0.5 / 20.5)):
        for found, true in zip((direct, indirect), truth, strict=True):
            error = (found - true * dim)[rows]
            # twice the mean and twice the amplitude of four readings, less twice the black one: √(1 + 2 + 4) times the noise of a reading
            assert np.sqrt((error**2).mean()) < 7**0.5 * 1.15 * sigma, rows


BOTH = [*phases(), *phases(axis="row"), BLACK]


@pytest.mark.parametrize(("patterns", "gamma", "factors", "words"), [
    (BOTH, 1.0, {}, None),
    ([*phases(), BLACK], 2.2, {}, "of their amplitude off a sinusoid"),
    (BOTH, 1.0, {2: 1.3}, "of their amplitude off a sinusoid"),
    ([*phases(steps=3), *phases(axis="row", steps=3), BLACK], 1.0, {0: 1.2, 1: 1.2, 2: 1.2}, "of columns and of rows differs by 18 %"),
    ([*phases(steps=3), BLACK, WHITE], 1.0, {}, None),
    ([*phases(steps=3), BLACK, WHITE], 1.0, {0: 1.05, 1: 0.97}, "in some places of the wave than in others, by 2"),
    ([*phases(steps=3), BLACK, WHITE], 1.0, {3: 1.02, 4: 1.05}, None),
], ids=["right", "gamma", "a frame brighter", "columns brighter", "three shifts", "one of three shifts brighter", "white brighter"])
def test_waves_that_are_none_are_said(relit, tmp_path, patterns, gamma, factors, words):
    write(tmp_path, patterns, gamma=gamma, ambient=0.02)
    random = np.random.default_rng(5)
    for number in range(len(patterns)):
        image, _ = exr.read(tmp_path / f"{number}.exr")
        pixels = np.stack([image[channel] for channel in "RGB"], axis=-1) * factors.get(number, 1.0)
        write_exr(tmp_path / f"{number}.exr", pixels + random.normal(0, 0.002, pixels.shape))
    warnings = solve(relit, tmp_path)[4].get("warnings", [])
    assert (warnings == []) if words is None else any(words in sentence for sentence in warnings), warnings


def test_a_copy_of_a_frame_is_named(relit, tmp_path):
    write(tmp_path, phases(steps=3))
    (tmp_path / "2.exr").write_bytes((tmp_path / "1.exr").read_bytes())
    assert "2.exr is an exact copy of 1.exr" in relit.refused("separate", tmp_path, "--out", tmp_path / "out", "--device", "cpu")


def test_the_black_level_of_the_paper(relit, tmp_path):
    write(tmp_path, phases(), leak=0.04)
    direct, indirect, _, _, report = solve(relit, tmp_path, "--black-level", 0.04)
    truth = known()
    np.testing.assert_allclose(direct, truth[0], atol=2e-6)
    np.testing.assert_allclose(indirect, truth[1], atol=4e-6)
    assert report["found"]["ambient"] == "none" and report["found"]["sum_over_white"] is None
    assert report["options"] == {"capture": str(tmp_path), "period_px": None, "black_level": 0.04, "clip_negative": False, "crop": None}


def test_off_frames_are_ambient_light_and_a_period_is_chosen(relit, tmp_path):
    write(tmp_path, [*phases(), *phases(200)], ambient=0.2)
    write_exr(tmp_path / "off.exr", np.full((ROWS, COLS, 3), 0.2))
    edit_manifest(tmp_path, frames=lambda frames: [*frames, {"image": "off.exr", "light": {"type": "off"}}])
    direct, indirect, _, _, report = solve(relit, tmp_path, "--period-px", 200)
    np.testing.assert_allclose(direct, known()[0], atol=2e-6)
    np.testing.assert_allclose(indirect, known()[1], atol=2e-6)
    assert report["found"]["ambient"] == "off frames" and report["found"]["period_px"] == 200


def test_mask_saturation_and_provenance(relit, tmp_path):
    write(tmp_path, [*phases(), BLACK], mask="mask.png", saturation=0.6)
    mask = np.zeros((ROWS, COLS), np.uint8)
    mask[2:] = 255
    write_image(tmp_path / "mask.png", mask)
    direct, indirect, channels, metadata, report = solve(relit, tmp_path)
    recorded = np.stack([exr.read(tmp_path / f"{n}.exr")[0][c] for n in range(4) for c in "RGB"])
    cut = (recorded >= 0.6).any(axis=0)
    assert cut[2:].any() and not cut.all()
    np.testing.assert_array_equal(channels["status.Y"], np.where(mask == 0, 0, np.where(cut, 6, 1)))
    np.testing.assert_array_equal(channels["mask.Y"] > 0, (mask > 0) & ~cut)
    assert (direct[channels["mask.Y"] == 0] == 0).all() and (indirect[channels["mask.Y"] == 0] == 0).all()
    assert metadata["relit:capture"] == "wax" and json.loads(metadata["relit:options"]) == {"black_level": 0.0, "method": "separation"}
    assert metadata["relit:inputs"] == report["inputs"]["content"] and "relit:camera" in metadata


def test_bands_do_not_show(relit, tmp_path, monkeypatch):
    write(tmp_path, [*phases(), BLACK])
    whole = solve(relit, tmp_path)[:2]
    monkeypatch.setattr("stage.stack.planes.BAND_BYTES", 5 * COLS * (4 * 5 * 3 + 80))  # five rows
    for one, other in zip(whole, solve(relit, tmp_path)[:2], strict=True):
        np.testing.assert_array_equal(one, other)


def fails(relit, folder: Path, words: str, *arguments):
    assert words in relit.refused("separate", folder, "--out", folder / "out", *arguments)
    assert files_in(folder / "out") == set()


@pytest.mark.parametrize("patterns, given, words", [
    ([WHITE, BLACK], [], "frames: no period of a phase pattern has three shifts or"),
    ([*phases()[:2], BLACK], [], "frames: no period of a phase pattern has three shifts or"),
    (phases(256), [], "frames: the shortest period is 256 px, which light between"),
    ([*phases(16), *phases(18)], ["--period-px", 20], "--period-px 20: the phase frames have periods of 16, 18 px"),
    ([*phases(), BLACK], ["--black-level", 0.1], "--black-level 0.1: the capture has a black frame"),
    (phases(), ["--black-level", 1], "--black-level"),
    ([*phases(), phases()[0]], [], "frames 0 and 4 show one pattern"),
    ([*phases(), BLACK, WHITE], {"gamma": 2.2}, "of the white frame: the patterns must be linear in light"),
    ([*phases(), WHITE], {"ambient": 0.2}, "ambient light needs a black or an off frame"),
    ([*phases(), BLACK], {"saturation": 0.01}, f"no pixel is separated ({ROWS * COLS} saturated)"),
])
def test_what_cannot_be_separated_is_one_sentence(relit, tmp_path, patterns, given, words):
    options, scene = (given, {}) if isinstance(given, list) else ([], given)
    fails(relit, write(tmp_path, patterns, **scene), words, *options)


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """Direct and white light of the rig, [rows, cols], with its truth and what the projector gives each surface (irradiance over π)."""
    out = tmp_path_factory.mktemp("separation")
    separate(SeparateRequest(capture=RIG, out=out, cache=out, device="cpu"))
    channels, _ = exr.read(out / "separation.exr")
    direct, indirect = channels["direct.R"], channels["global.R"]
    truth, capture = read_truth(RIG / "truth.exr"), Capture.open(RIG)
    x, y = capture.camera.plane_coordinates()
    points = np.stack([x, y, -np.ones_like(x)], axis=-1) * truth.depth[..., None]
    normal = depth_normals(truth.depth, truth.clean, capture.camera)
    pose = np.array(capture.manifest.projector.camera_from_projector)
    to_light = pose[:3, 3] - points
    given = (normal * to_light).sum(axis=-1) / (to_light @ pose[:3, 2]) ** 3  # planes that face it are evenly lit, 1 at 1 m
    known = truth.clean & (np.linalg.norm(normal, axis=-1) > 0.5)
    return direct, indirect, truth, given, known


def test_the_groove_has_its_albedo_in_direct_light_alone(rig):
    """Its walls, of albedo 0.78 ± 0.05, light each other: white light makes them look brighter than any paint."""
    direct, indirect, truth, given, known = rig
    groove = known & truth.groove
    albedo, under_white = direct[groove] / given[groove], (direct + indirect)[groove] / given[groove]
    assert np.median(albedo) == pytest.approx(0.78, abs=0.03)
    assert np.percentile(albedo, [5, 95]) == pytest.approx([0.73, 0.83], abs=0.06)
    assert np.median(under_white) > 0.95


def test_open_ground_has_little_global_light_and_shadow_no_direct(rig):
    direct, indirect, truth, _, known = rig
    share = indirect / np.maximum(direct + indirect, 1e-6)
    assert np.median(share[known & ~truth.groove]) < 0.04  # of which 1.6 % are the pixels of projector and camera, which blur 16 px
    assert 0.2 < np.median(share[known & truth.groove]) < 0.3
    shadow = truth.shadow
    assert np.median(direct[shadow]) < 0.002 < np.median(indirect[shadow])
