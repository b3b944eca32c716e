"""Stacks of projected patterns in the orders and with the calibrations of other programs: from files to true depth in two commands."""

import json

import cv2
import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.formats import exr
from stage.importers.opencv_file import read_matrices
from tests.marks import first_short
from tests.reference.projector import FLIP
from tests.scenes import stereo
from tests.scenes.captures import files_in, write_image
from tests.scenes.depth import AMBIENT, CAMERA, POSE, PROJECTOR, make_scene
from tests.scenes.projected import Ball, Wall

SCENE = make_scene()
LIT = (SCENE.uv > 0).all(axis=-1) & (SCENE.uv < (PROJECTOR.width, PROJECTOR.height)).all(axis=-1) & ~SCENE.shaded
U, V = SCENE.uv[..., 0], SCENE.uv[..., 1]
WHITE, BLACK = np.ones(U.shape), np.zeros(U.shape)
SIZE = f"{PROJECTOR.width}x{PROJECTOR.height}"


def gray(at, bit, stripe=1, inverse=False):
    """The level of a bit of the Gray code of the stripe at a place of the projector."""
    number = np.floor(at / stripe).astype(int)
    return (((number ^ number >> 1) >> bit & 1) ^ inverse).astype(float)


def wave(at, period, turns):
    return (1 + np.cos(2 * np.pi * (at / period + turns))) / 2


def write_stack(folder, levels, name="frame_{}.png", first=0):
    """16-bit images of a scene under these levels, numbered without zeros in front, as many programs do."""
    for number, level in enumerate(levels, start=first):
        image = SCENE.albedo * (0.8 * level * ~SCENE.shaded + AMBIENT)[..., None]
        full, kind = (255, np.uint8) if name.endswith("bmp") else (65535, np.uint16)
        write_image(folder / name.format(number), np.rint(image * full).astype(kind))


def write_calibration(path, names, unit_m=0.001, *, devices=(CAMERA, PROJECTOR), pose=POSE, **sizes):
    """What cv2.stereoCalibrate gives for this rig, with the camera first, by the names of a program; translations in millimetres."""
    rotation = FLIP @ pose[:3, :3].T @ FLIP
    values = [part for device in devices for part in (
        np.array([[device.focal, 0, device.principal[0] - 0.5], [0, device.focal, device.principal[1] - 0.5], [0, 0, 1]]),
        np.array([[*device.k[:2], *device.p, device.k[2]]]))]
    values += [rotation, (-rotation @ FLIP @ pose[:3, 3] / unit_m)[:, None]]
    path.parent.mkdir(parents=True, exist_ok=True)
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in zip(names, values, strict=True):
        file.write(name, value)
    for name, value in sizes.items():
        file.write(name, value)
    file.release()
    return path


OPENCV, SLSTUDIO = ("M1", "D1", "M2", "D2", "R", "T"), ("Kc", "kc", "Kp", "kp", "Rp", "Tp")
SIZES = {"frameWidth": CAMERA.width, "frameHeight": CAMERA.height, "screenResX": PROJECTOR.width, "screenResY": PROJECTOR.height}


def depth_of(relit, folder, *words):
    """Import a folder, solve it, and return the result and what was printed."""
    out = relit("import", words[0], folder, *words[1:]).well()
    return relit.depth(folder).maps, out


def error(maps):
    return np.abs(maps.depth - SCENE.depth)[maps.mask]


COLUMN_M = 0.065
"""Metres of depth that a projector column is worth here, at most."""


@first_short("layout", ["references first, no inverses", "inverses first", "inverses in blocks, fine first", "fewer bits",
                        "OpenCV's, as a scanner"])
def test_gray_codes(relit, tmp_path, layout):
    calibration = write_calibration(tmp_path / "rig.yml", OPENCV)
    rig = ("--calibration", calibration, "--unit-m", "0.001", "--projector", SIZE)
    columns, rows = range(6, -1, -1), range(6, -1, -1)
    if layout == "references first, no inverses":
        write_stack(tmp_path, [WHITE, BLACK, *(gray(U, bit) for bit in columns), *(gray(V, bit) for bit in rows)])
        maps, out = depth_of(relit, tmp_path, "gray", "--sequence", "white,black,columns,rows", "--inverses", "none", *rig)
        assert "black, Gray code of columns, 7 bits, Gray code of rows, 7" in out
    elif layout == "inverses in blocks, fine first":
        write_stack(tmp_path, [gray(U, bit, inverse=turned) for turned in (False, True) for bit in reversed(columns)], "IMG_{}.png", 8)
        maps, _ = depth_of(relit, tmp_path, "gray", "--sequence", "columns", "--inverses", "blocks", "--fine-first", *rig)
    elif layout == "inverses first":
        write_stack(tmp_path, [gray(U, bit, inverse=turned) for bit in columns for turned in (True, False)])
        maps, _ = depth_of(relit, tmp_path, "gray", "--sequence", "columns", "--inverses", "first", *rig)
    elif layout == "fewer bits":
        write_stack(tmp_path, [gray(U, bit, 4, turned) for bit in range(4, -1, -1) for turned in (False, True)])
        maps, _ = depth_of(relit, tmp_path, "gray", "--sequence", "columns", "--column-bits", "5", *rig)
    else:
        write_stack(tmp_path, [*(gray(at, bit, inverse=turned) for at, bits in ((U, columns), (V, rows)) for bit in bits
                                 for turned in (False, True)), WHITE, BLACK])
        maps, _ = depth_of(relit, tmp_path, "scanner", "--codec", "opencv-gray", "--axis", "both", *rig)
    assert maps.mask[LIT].mean() > 0.9 and np.median(error(maps)) < COLUMN_M
    assert layout == "fewer bits" or error(maps).max() < 1.5 * COLUMN_M  # one where a bit is in doubt, half by the rows


PERIODS = (16.0, 18.0, 21.0)


@pytest.mark.long
@pytest.mark.parametrize("layout", ["as relit's", "sines that move back, steps slowest", "rows too", "from the number of the pixel",
                                    "an offset between two steps"])
def test_phases(relit, tmp_path, layout):
    rig = ("--calibration", write_calibration(tmp_path / "rig.yml", OPENCV), "--unit-m", "0.001", "--projector", SIZE)
    stack = ("--periods", "16,18,21", "--steps", "4")
    if layout == "as relit's":
        write_stack(tmp_path, [wave(U, period, -step / 4) for period in PERIODS for step in range(4)])
        maps, out = depth_of(relit, tmp_path, "phase", *stack, *rig)
        assert "12 images in their order, frame_0.png to frame_11.png" in out and "phase of columns, 4 steps" in out
    elif layout == "sines that move back, steps slowest":
        write_stack(tmp_path, [wave(U, period, -0.25 + step / 4) for step in range(4) for period in PERIODS])
        maps, _ = depth_of(relit, tmp_path, "phase", *stack, "--shift", "plus", "--offset-deg", "-90", "--order", "axis,step,period", *rig)
    elif layout == "an offset between two steps":
        write_stack(tmp_path, [wave(U, period, 40 / 360 - step / 4) for period in PERIODS for step in range(4)])
        maps, _ = depth_of(relit, tmp_path, "phase", *stack, "--offset-deg", "40", *rig)
    elif layout == "from the number of the pixel":
        write_stack(tmp_path, [wave(U - 0.5, period, -step / 4) for period in PERIODS for step in range(4)])
        maps, _ = depth_of(relit, tmp_path, "phase", *stack, "--origin", "centre", *rig)
    else:
        write_stack(tmp_path, [wave(at, period, -step / 4) for at in (U, V) for period in PERIODS for step in range(4)])
        write_stack(tmp_path, [WHITE, BLACK], "{}.png")
        (tmp_path / "0.png").rename(tmp_path / "white.png")
        (tmp_path / "1.png").rename(tmp_path / "black.png")
        maps, out = depth_of(relit, tmp_path, "phase", *stack, "--axis", "both", *rig)
        assert "white    white.png" in out and "black    black.png" in out
    assert maps.mask[LIT].mean() > 0.97 and np.median(error(maps)) < 0.01 * COLUMN_M and error(maps).max() < 0.2 * COLUMN_M  # 16 bits


def test_a_phase_with_a_gray_code(relit, tmp_path):
    rig = ("--calibration", write_calibration(tmp_path / "rig.xml", OPENCV), "--unit-m", "0.001", "--projector", SIZE)
    write_stack(tmp_path, [wave(U, 16, -step / 4) for step in range(4)], "phase_{}.png")
    write_stack(tmp_path, [gray(U, bit, 8) for bit in range(3, -1, -1)], "gray_{}.png")
    write_stack(tmp_path, [WHITE, BLACK], "even_{}.png")
    maps, _ = depth_of(relit, tmp_path, "phase", "--periods", "16", "--steps", "4", "--images", "phase_*", "--gray-images", "gray_*",
                       "--gray-stripe", "8", "--white", "even_0.png", "--black", "even_1.png", *rig)
    assert maps.mask[LIT].mean() > 0.97 and error(maps).max() < 0.2 * COLUMN_M


@first_short("order", ["black, white", "white and black first"])
def test_white_and_black_elsewhere_than_in_opencv_order_are_named(relit, tmp_path, order):
    rig = ("--calibration", write_calibration(tmp_path / "rig.yml", OPENCV), "--unit-m", "0.001", "--projector", SIZE)
    stripes = [gray(at, bit, inverse=turned) for at in (U, V) for bit in range(6, -1, -1) for turned in (False, True)]
    write_stack(tmp_path, [*stripes, BLACK, WHITE] if order == "black, white" else [WHITE, BLACK, *stripes])
    relit("import", "opencv-gray", tmp_path, *rig).well()
    if order == "black, white":
        relit("depth", tmp_path, "--out", tmp_path / "out").refused("black is brighter than white at 100 % of the lit pixels")
    else:
        relit("depth", tmp_path, "--out", tmp_path / "out")
        said = json.loads((tmp_path / "out" / "report.json").read_text())["warnings"]
        assert any("white and black are at the other end of the sequence" in sentence for sentence in said)


def test_stripes_wider_than_the_period_are_refused(relit, tmp_path):
    write_stack(tmp_path, [wave(U, 16, -step / 4) for step in range(4)], "phase_{}.png")
    write_stack(tmp_path, [gray(U, bit, 16) for bit in range(2, -1, -1)], "gray_{}.png")
    words = ("--periods", "16", "--steps", "4", "--images", "phase_*", "--gray-images", "gray_*", "--gray-stripe", "32")
    relit("import", "phase", tmp_path, "--projector", SIZE, *words).refused("--gray-stripe 32: stripes wider than the period of 16 px")


@pytest.mark.parametrize("codec", ["slstudio-gray", "slstudio-phase-2x3", "slstudio-micro", "slstudio-modulated"])
def test_slstudio(relit, tmp_path, codec):
    """frameSeq_0.bmp … as its scan worker writes them, with its calibration.xml; waves begin at the centre of the first column."""
    calibration = write_calibration(tmp_path / "calibration.xml", SLSTUDIO, **SIZES)
    if codec == "slstudio-gray":
        levels = [WHITE, BLACK, *(gray(U, bit) for bit in range(6, -1, -1))]
    elif codec == "slstudio-micro":
        levels = [*(wave(U - 0.5, 75.02, step / 3) for step in range(3)),
                  *(wave(U - 0.5, period, turns) for period, turns in zip((70, 71.32, 72.47, 73.72, 76.23, 77.35, 78.4, 79.22, 80),
                                                                          (0.5, 0, 0.5, 0, 0.5, 0, 0.5, 0, 0.5), strict=True))]
    elif codec == "slstudio-modulated":
        levels = [*(wave(U - 0.5, PROJECTOR.width / 8, -step / 3) * wave(V - 0.5, PROJECTOR.height / 16, -across / 3)
                    for step in range(3) for across in range(3)),
                  *(wave(U - 0.5, PROJECTOR.width, -step / 3) for step in range(3))]
    else:
        levels = [wave(U - 0.5, PROJECTOR.width / parts, -step / 3) for parts in (16, 1) for step in range(3)]
    write_stack(tmp_path, levels, "frameSeq_{}.bmp")
    maps, _ = depth_of(relit, tmp_path, "scanner", "--calibration", calibration, "--codec", codec, "--unit-m", "0.001")
    assert maps.mask[LIT].mean() > 0.9
    assert np.median(error(maps)) < (0.5 if codec == "slstudio-gray" else 0.05) * COLUMN_M  # half a column of the waves would be 0.5


@pytest.mark.parametrize(("words", "message"), [
    (("gray", "--projector", SIZE), "has 5 images (frame_0.png to frame_4.png) where these"),
    (("gray", "--projector", SIZE, "--sequence", "columns,lines"), "--sequence columns,lines: give some of columns, rows, white"),
    (("gray", "--projector", SIZE, "--column-bits", "9"), "--column-bits 9: a projector of 128 columns has 1 to 7 bits"),
    (("gray", "--projector", SIZE, "--white", "frame_0.png"), "white is in --sequence already: give one of both"),
    (("phase", "--projector", SIZE, "--periods", "16", "--steps", "4", "--order", "step,axis"), "--order step,axis: give axis, period"),
    (("phase", "--projector", SIZE, "--periods", "16", "--steps", "4", "--row-periods", "1,2"), "--row-periods: has 2 periods, --periods"),
    (("phase", "--projector", SIZE, "--periods", "16", "--steps", "4", "--gray-images", "x*"), "belong together: give both, or none"),
    (("phase", "--projector", SIZE, "--periods", "16", "--steps", "4", "--gray-images", "x*", "--gray-stripe", "8"), "names 0 images"),
    (("phase", "--projector", SIZE, "--periods", "16", "--steps", "5", "--calibration", "RIG"),
     "is of a camera of 96x72 px, this one has 9x8"),
    (("scanner", "--codec", "slstudio-micro", "--unit-m", "1", "--calibration", "RIG", "--axis", "both"), "code columns alone"),
    (("scanner", "--codec", "slstudio-gray", "--unit-m", "1", "--calibration", "NOSIZE"), "does not say how many pixels the projector has"),
])
def test_faults_are_named_and_nothing_is_written(relit, tmp_path, words, message):
    for number in range(5):
        write_image(tmp_path / "scan" / f"frame_{number}.png", np.zeros((8, 9), np.uint8))
    files = {"RIG": write_calibration(tmp_path / "calibration.xml", SLSTUDIO, **SIZES),
             "NOSIZE": write_calibration(tmp_path / "b.yml", OPENCV)}
    before = files_in(tmp_path)
    relit("import", words[0], tmp_path / "scan", *(files.get(word, word) for word in words[1:])).refused(message)
    assert files_in(tmp_path) == before


def test_without_a_calibration_the_columns_are_decoded_all_the_same(relit, tmp_path):
    write_stack(tmp_path, [wave(U, period, -step / 4) for period in PERIODS for step in range(4)])
    outcome = relit("import", "phase", tmp_path, "--projector", SIZE, "--periods", "16,18,21", "--steps", "4")
    assert outcome.code == 0 and "relit calibrate procam measures it" in outcome.out
    assert Capture.open(tmp_path).manifest.projector.resolution == (PROJECTOR.width, PROJECTOR.height)
    assert relit("depth", tmp_path, "--out", tmp_path / "out").code == 0
    channels, _ = exr.read(tmp_path / "out" / "depth.exr")
    mask = channels["mask.Y"] > 0.5
    assert mask[LIT].mean() > 0.97 and np.abs(channels["projector.U"] - U)[mask].max() < 0.05


DARK = np.zeros((stereo.CAMERA.height, stereo.CAMERA.width), np.uint8)


def write_views(folder, *names, images=(DARK, DARK)):
    """One image of each of two cameras, in folders of these names."""
    for name, image in zip(names, images, strict=True):
        write_image(folder / name / f"{name}_frame.png", image)


@first_short("kind", ["two files", "JSON"])
def test_calibrations_of_two_cameras(relit, tmp_path, kind):
    """What cv2.stereoCalibrate found, as OpenCV's sample stereo_calib writes it in two files, and as a program in another language does."""
    write_views(tmp_path, "cam0", "cam.1")
    rig = write_calibration(tmp_path / "rig.yml", OPENCV, devices=(stereo.CAMERA, stereo.OTHER), pose=stereo.POSE)
    found = read_matrices(rig)
    words = "import", "stereo", tmp_path / "cam0", tmp_path / "cam.1", tmp_path / "pair", "--unit-m", "0.001", "--calibration"
    if kind == "JSON":
        given = [tmp_path / "rig.json"]
        given[0].write_text(json.dumps({name: matrix.tolist() for name, matrix in found.items()}))
    else:
        for name, own in (("intrinsics.yml", OPENCV[:4]), ("extrinsics.yml", OPENCV[4:])):
            file = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_WRITE)
            for key in own:
                file.write(key, found[key])
            file.release()
        relit(*words, rig, "--extrinsics", tmp_path / "intrinsics.yml").refused("intrinsics.yml")
        given = [tmp_path / "intrinsics.yml", "--extrinsics", tmp_path / "extrinsics.yml"]
    assert f"{np.linalg.norm(stereo.POSE[:3, 3]):.4g} m from the first camera" in relit(*words, *given).well()
    other, truth = Capture.open(tmp_path / "pair").manifest.other_cameras[0], stereo.OTHER
    assert other.name == "cam.1"
    np.testing.assert_allclose(other.camera_from_other, stereo.POSE, atol=1e-12)
    np.testing.assert_allclose((*other.focal_px, *other.principal_px), (truth.focal, truth.focal, *truth.principal), atol=1e-9)


@pytest.mark.long
def test_two_cameras_have_the_true_depth_in_two_commands(relit, tmp_path):
    """Both views of a tilted plane and a sphere under dots."""
    parts, dots = (Wall((0.02, 0.0, -1.15), (-0.3, 0.22, 1.0), 0.6), Ball((0.08, -0.04, -0.95), 0.11, 0.6)), [stereo.dots(100, cell=3)]
    left, right = (stereo.render(parts, dots, *camera, side=2) for camera in ((stereo.CAMERA,), (stereo.OTHER, stereo.POSE)))
    random = np.random.default_rng(0)
    write_views(tmp_path, "a", "b", images=[stereo.recorded(view.images[0], random) for view in (left, right)])
    rig = write_calibration(tmp_path / "rig.yml", OPENCV, devices=(stereo.CAMERA, stereo.OTHER), pose=stereo.POSE)
    relit.done("import", "stereo", tmp_path / "a", tmp_path / "b", tmp_path / "pair", "--unit-m", "0.001", "--calibration", rig)
    maps, *_ = relit.depth(tmp_path / "pair")
    visible = stereo.visible_to(parts, left.points, stereo.POSE)
    off = np.abs(maps.depth - left.depth)[maps.mask & visible]  # a pixel of disparity is 19 to 27 mm at 1 to 1.2 m
    assert maps.mask[visible].mean() > 0.7 and np.median(off) < 0.006 and (off > 0.03).mean() < 0.02


@pytest.mark.parametrize("factor", [0.5, 1.0, 1.5, 2.0])
def test_calibrations_at_another_size_of_images_are_named(relit, tmp_path, factor):
    """Focal lengths and principal points of images that were binned since; without a word their depths are refused or wrong."""
    larger = [device._replace(width=round(factor * device.width), height=round(factor * device.height), focal=factor * device.focal)
              for device in (stereo.CAMERA, stereo.OTHER)]
    write_views(tmp_path, "a", "b")
    words = ("import", "stereo", tmp_path / "a", tmp_path / "b", "--unit-m", "0.001", "--calibration")
    out = relit(*words, write_calibration(tmp_path / "rig.yml", OPENCV, devices=larger, pose=stereo.POSE)).well()
    named = [f"{field}.principal_px: the calibration is of images of 320x240 px" for field in ("camera", "other_cameras[0]")]
    assert all((sentence in out) == (factor != 1) for sentence in named)
    assert [any(sentence in doubt for doubt in Capture.open(tmp_path).doubts) for sentence in named] == [factor != 1] * 2
    size = {"image_width": larger[0].width, "image_height": larger[0].height}
    told = relit(*words, write_calibration(tmp_path / "told.yml", OPENCV, devices=larger, pose=stereo.POSE, **size))
    assert (told.code == 0) == (factor == 1) and (factor == 1 or "told.yml: is of a camera of {}x{} px".format(*size.values()) in told.err)


def test_the_second_camera_may_have_images_of_another_size(relit, tmp_path):
    """`image_width` is that of the first."""
    wide = stereo.OTHER._replace(width=400, height=300)
    for folder, device in (("a", stereo.CAMERA), ("b", wide)):
        write_image(tmp_path / folder / "0.png", np.zeros((device.height, device.width), np.uint8))
    rig = write_calibration(tmp_path / "rig.yml", OPENCV, devices=(stereo.CAMERA, wide), pose=stereo.POSE, image_width=stereo.CAMERA.width,
                            image_height=stereo.CAMERA.height)
    out = relit("import", "stereo", tmp_path / "a", tmp_path / "b", "--calibration", rig, "--unit-m", "0.001").well()
    assert "principal_px" not in out and Capture.open(tmp_path).manifest.other_cameras[0].resolution == (400, 300)


@pytest.mark.parametrize(("left", "right", "message"), [
    (("a/0.png", "a/1.png"), ("b/0.png",), "has 1 images and"), (("c/a/0.png",), ("b/0.png",), "does not lie beside"),
    (("a/0.png", "a/1.png", "a/3.png", "a/4.png"), ("b/0.png", "b/1.png", "b/2.png", "b/4.png"), "a/3.png: would be paired with 2.png"),
    (("a/0.png",), ("b/0.txt",), "holds no images"), (("a/0.png",), ("a/1.png",), "is named as the left and as the right camera")])
def test_pairs_that_are_none(relit, tmp_path, left, right, message):
    for name in (*left, *right):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        write_image((tmp_path / name).with_suffix(".png"), np.zeros((8, 9), np.uint8)).rename(tmp_path / name)
    rig = write_calibration(tmp_path / "rig.yml", OPENCV)
    before = files_in(tmp_path)
    relit("import", "stereo", (tmp_path / left[0]).parent, (tmp_path / right[0]).parent, "--calibration", rig).refused(message)
    assert files_in(tmp_path) == before


def test_pairs_may_be_numbered_each_in_its_own_way(relit, tmp_path):
    """From 0 and from 1 on, or by a clock."""
    rig = write_calibration(tmp_path / "rig.yml", OPENCV, pose=stereo.POSE)
    for case, right in (("shifted", (1, 2, 3, 4)), ("clock", (100, 203, 298, 401))):
        for folder, numbers in (("a", range(4)), ("b", right)):
            for number in numbers:
                write_image(tmp_path / case / folder / f"{number}.png", np.zeros((stereo.CAMERA.height, stereo.CAMERA.width), np.uint8))
        relit("import", "stereo", tmp_path / case / "a", tmp_path / case / "b", "--calibration", rig, "--unit-m", "0.001").well()


@pytest.mark.parametrize("unit", ["0.001", "1e-9"], ids=["no translation", "a wrong unit"])
def test_two_cameras_in_one_place_are_refused(relit, tmp_path, unit):
    write_views(tmp_path, "a", "b")
    pose = stereo.POSE.copy()
    if unit == "0.001":
        pose[:3, 3] = 0
    rig = write_calibration(tmp_path / "rig.yml", OPENCV, devices=(stereo.CAMERA, stereo.OTHER), pose=pose)
    before, words = files_in(tmp_path), ("import", "stereo", tmp_path / "a", tmp_path / "b", "--calibration", rig, "--unit-m")
    relit(*words, unit).refused("rig.yml: T: the second camera stands")
    assert files_in(tmp_path) == before
