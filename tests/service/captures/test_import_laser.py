"""Imports of laser stripes and of videos."""

import json

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from stage.capture.capture import Capture
from stage.formats import exr
from stage.formats.images import read_recorded
from stage.patterns.binary import binary_patterns
from tests.reference import projector as reference
from tests.reference.colour import srgb
from tests.scenes.captures import files_in, write_image

CAMERA = reference.Device(160, 120, 260.0, (-0.1, 0.02, 0.0), (0.001, -0.0005))
RAYS = reference.pixel_rays(CAMERA)
TRUTH = np.fmax(*(reference.plane_depth(RAYS, (0.0, 0.0, -0.9), (0.1, slope, 1.0)) for slope in (0.3, -0.2)))
"""Two walls that meet, which hide nothing from each other."""
POINTS = RAYS * TRUTH[..., None]
LASER = np.array((0.3, 0.02, 0.0))
NORMALS = [np.array((np.cos(angle), 0.05, np.sin(angle))) / np.hypot(1, 0.05) for angle in np.radians(np.linspace(-10, -27, 12))]
OPENCV = np.diag([1.0, -1.0, -1.0])
"""OpenCV's axes from those of relit, and back."""
WIDTH, ROWS, COLS = 64, 40, 96
U = np.broadcast_to(3.4 + 0.6 * np.arange(COLS), (ROWS, COLS))
HOLD = 3  # frames for which each pattern is shown
PATTERNS = [pattern for pattern in binary_patterns(WIDTH, "column", inverses=True) if pattern.code == "gray"]


def write_grey(path, image):
    write_image(path, np.repeat(np.rint(image * 65535)[..., None], 3, axis=2).astype(np.uint16))


def write_scan(folder, *, background=True):
    """16-bit PNG, laser_0.png …, and one without the laser."""
    albedo = 0.5 + 0.2 * np.sin(40 * POINTS[..., 0])
    for number, normal in enumerate(NORMALS):
        glow = np.exp(-(((POINTS - LASER) @ normal) ** 2) / (2 * 0.004**2))
        write_grey(folder / f"laser_{number}.png", albedo * (0.05 + 0.8 * glow))
    if background:
        write_grey(folder / "background.png", albedo * 0.05)


def write_camera(path):
    """As cv2's calibration sample writes it."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    cu, cv = CAMERA.principal
    file.write("camera_matrix", np.array([[CAMERA.focal, 0, cu - 0.5], [0, CAMERA.focal, cv - 0.5], [0, 0, 1]]))
    file.write("distortion_coefficients", np.array([*CAMERA.k[:2], *CAMERA.p, CAMERA.k[2]]))
    file.release()
    return path


def coefficients(sign=-1.0):
    """a, b, c, d in millimetres on OpenCV's axes: a x + b y + c z + d = 0, or with sign 1 = d."""
    return np.array([[*(OPENCV @ normal), sign * 1000 * normal @ LASER] for normal in NORMALS])


def as_csv(folder):
    rows = [f"laser_{number}.png," + ",".join(f"{value:.9g}" for value in row) for number, row in enumerate(coefficients())]
    (folder / "planes.csv").write_text("image,a,b,c,d\n" + "\n".join(rows[::-1]) + "\n")
    return "planes.csv", "zero"


def as_text(folder):
    (folder / "laser_planes.txt").write_text("# a b c d\n" + "\n".join(" ".join(f"{v:.9g}" for v in row) for row in 3 * coefficients()))
    return "laser_planes.txt", "zero"  # of any length


def with_commas(folder):
    """As a spreadsheet of another country writes it."""
    (folder / "planes.csv").write_text("a;b;c;d\n" + "\n".join(";".join(f"{v:.9f}" for v in row) for row in 3 * coefficients())
                                       .replace(".", ","), encoding="utf-16")
    return "planes.csv", "zero"


def as_yaml(folder):
    file = cv2.FileStorage(str(folder / "laser.yml"), cv2.FILE_STORAGE_WRITE)
    file.write("laser_planes", coefficients(1.0))
    file.release()
    return "laser.yml", "equals"


def as_mat(folder):
    savemat(folder / "planes.mat", {"planes": np.array([[*(OPENCV @ LASER * 1000), *(OPENCV @ normal)] for normal in NORMALS])})
    return "planes.mat", None


def as_json(folder):
    planes = [{"normal": row[:3].tolist(), "distance": row[3]} for row in coefficients(1.0)]
    (folder / "planes.json").write_text(json.dumps({"laser_planes": planes}))
    return "planes.json", "equals"


def as_points(folder):
    np.save(folder / "planes.npy", np.array([[*(OPENCV @ LASER * 1000), *(OPENCV @ -normal)] for normal in NORMALS]))
    return "planes.npy", None


@pytest.mark.long
@pytest.mark.parametrize("write", [as_csv, as_text, with_commas, as_yaml, as_mat, as_json, as_points])
def test_planes_of_any_file_give_the_true_depth(relit, tmp_path, write):
    """The stripe is 1.2 px wide (standard deviation) and the baseline 0.3 m: the texture
    moves a stripe by tenths of a pixel, each of which is 1.2 mm of depth."""
    folder = tmp_path / "scan"
    write_scan(folder)
    camera = write_camera(tmp_path / "camera.yml")
    name, form = write(folder)
    words = "import", "laser", folder, "--camera", camera, "--planes", folder / name, "--axes", "right,down,away", "--unit-m", 0.001
    out = relit(*words, *(() if form is None else ("--form", form))).well()
    assert "12 planes from" in out and "background.png shows the scene without the laser" in out
    found = [frame.laser for frame in Capture.open(folder).manifest.frames if frame.laser]
    for laser, normal in zip(found, NORMALS[::-1] if write is as_csv else NORMALS, strict=True):
        assert abs(abs(np.dot(laser.normal, normal)) - 1) < 1e-9
    maps, *_ = relit.depth(folder, "--device", "cpu")
    error = np.abs(maps.depth - TRUTH)[maps.mask]
    assert maps.mask.sum() > 800 and np.median(error) < 0.0012 and np.quantile(error, 0.99) < 0.003


@pytest.fixture
def scan(tmp_path):
    """A folder of images, the file of its camera, and the words that import them with planes in a text."""
    folder = tmp_path / "scan"
    write_scan(folder)
    name, _ = as_text(folder)
    return folder, write_camera(tmp_path / "camera.yml"), ("--planes", folder / name, "--axes", "right,down,away", "--unit-m", 0.001)


def test_a_wrong_form_has_no_depth(relit, tmp_path, scan):
    """The planes of the other sign meet the lines of sight behind the camera."""
    folder, camera, planes = scan
    assert relit("import", "laser", folder, "--camera", camera, *planes, "--form", "equals").code == 0
    relit("depth", folder, "--out", tmp_path / "out", "--device", "cpu").refused("no laser frame has a depth")


def test_without_planes_there_are_placeholders(relit, tmp_path):
    write_scan(tmp_path / "scan", background=False)
    camera = write_camera(tmp_path / "camera.yml")
    outcome = relit("import", "laser", tmp_path / "scan", "--camera", camera)
    assert outcome.code == 0 and "with placeholders: relit calibrate laser-planes measures the" in outcome.out
    assert "the least of all images is taken" in outcome.out
    assert relit("info", tmp_path / "scan").code == 0


def test_what_does_not_fit_is_one_sentence(relit, scan):
    folder, camera, given = scan
    name = given[1]

    def refused(*words):
        assert not (folder / "capture.json").exists()
        return relit("import", "laser", folder, *words).refused("")

    assert "perspective camera: give --camera FILE or --focal-px" in refused(*given, "--form", "zero")
    assert "of each plane: say what they mean, --form zero for a x + b y" in refused("--camera", camera, *given)
    assert "needs --axes" in refused("--camera", camera, "--planes", folder / name)
    assert "are those of --planes, which is not given" in refused("--camera", camera, "--unit-m", 0.001)
    some = refused("--camera", camera, *given, "--form", "zero", "--images", "laser_?.png")
    assert "holds 12 planes, and there are 10 images (laser_0.png to" in some
    for content, sentence in (("0 0 1 2\n", "holds one plane, and there are 12 images"), ("1 2 3\n", "line 1: '1 2 3' is no plane"),
                              ("0 0 0 2\n" * 12, "plane 1: its normal is zero"), ("\n", "holds no planes"),
                              ("0 0 1 2\n0 0 1 2 3 4\n", "its rows differ"), ("other.png 0 0 1 2\n", "other.png is not among the images")):
        (folder / name).write_text(content)
        assert sentence in refused("--camera", camera, *given, "--form", "zero")
    (folder / "p.json").write_text(json.dumps({"planes": [{"normal": [1, 0, 0]}]}))
    assert "there must be the planes of the laser" in refused("--camera", camera, "--planes", folder / "p.json", *given[2:])


def images():
    found = []
    for pattern in PATTERNS:
        light = 0.04 + 0.9 * pattern.level(U, None, WIDTH)
        codes = np.rint(255 * srgb(light))
        found.append(np.repeat(codes.astype(np.uint8)[..., None], 3, axis=2))
    return found


def video(path, codec):
    """Two frames before the first pattern; each is shown for three, the first of them in transition."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 30, (COLS, ROWS))
    assert writer.isOpened()
    before = np.zeros((ROWS, COLS, 3), np.uint8)
    for blank in (before, before):
        writer.write(blank)
    for image in images():
        writer.write((image // 2 + before // 2).astype(np.uint8))
        for _ in range(HOLD - 1):
            writer.write(np.ascontiguousarray(image[..., ::-1]))
        before = image
    writer.release()
    return path


def imported(relit, path, folder, frames, *options):
    return relit("import", "gray", path, folder, "--projector", f"{WIDTH}x32", "--sequence", "columns", "--video-frames", frames, *options)


@pytest.mark.parametrize(("codec", "suffix"), [("FFV1", "avi"), ("MJPG", "avi"), ("mp4v", "mp4")])
def test_a_video_goes_to_columns_in_two_commands(relit, tmp_path, codec, suffix):
    path, folder = video(tmp_path / f"scan.{suffix}", codec), tmp_path / "scan"
    last = 2 + HOLD * len(PATTERNS) - 1
    out = imported(relit, path, folder, f"4-{last}:{HOLD}").well()
    manifest = Capture.open(folder).manifest
    assert manifest.color_space == "srgb_texture"
    names = [frame.image for frame in manifest.frames]
    assert names == [f"scan_{4 + HOLD * number:06d}.png" for number in range(len(PATTERNS))]
    if codec == "FFV1":
        assert "lossless" in out and manifest.assumed == ()
        for name, expected in zip(names, images(), strict=True):
            assert np.abs(read_recorded(folder / name).astype(int) - expected).max() <= 2  # through YUV of 8 bits
    else:
        assert "compressed" in out and "frames of a compressed video (" in manifest.assumed[0]
    relit("depth", folder, "--out", tmp_path / "out", "--device", "cpu").well()
    layers, _ = exr.read(tmp_path / "out" / "depth.exr")
    near = layers["mask.Y"] > 0.5
    assert near.mean() > 0.7 and np.abs(layers["projector.U"] - U)[near].max() < 1.5  # stripes of a pixel, sampled at 0.6
    said = json.loads((tmp_path / "out" / "report.json").read_text())["warnings"]
    assert any("compressed video" in warning for warning in said) == (codec != "FFV1")


BAD = {
    "too long": ("scan.avi", "4-900:3", "has 38 frames, 0 to 37, and --video-frames asks for 4 to 900"),
    "backwards": ("scan.avi", "9-4", "--video-frames 9-4: goes backwards or nowhere"),
    "words": ("scan.avi", "all", "all: give first, last and step, such as 12-600:6"),
    "no video": ("text.mp4", "0-3", "text.mp4: is no video that OpenCV decodes"),
    "missing": ("none.mp4", "0-3", "none.mp4"),
    "another count": ("scan.avi", "2-10:3", "has 3 images (scan_000002.png to scan_000008.png) where"),
}


@pytest.mark.parametrize("fault", BAD)
def test_bad_videos(relit, tmp_path, fault):
    name, frames, words = BAD[fault]
    video(tmp_path / "scan.avi", "MJPG")
    (tmp_path / "text.mp4").write_text("no video")
    outcome = imported(relit, tmp_path / name, tmp_path / "scan", frames)
    assert outcome.code == 2 and words in outcome.err
    assert not (tmp_path / "scan" / "capture.json").exists()


def test_a_video_needs_a_folder_and_a_folder_no_frames(relit, tmp_path):
    path = video(tmp_path / "scan.avi", "MJPG")
    before = files_in(tmp_path)
    outcome = relit("import", "gray", path, "--projector", "64x32", "--sequence", "columns")
    assert outcome.code == 2 and "scan.avi: is a video: give a folder for its frames" in outcome.err
    assert "is no video" in imported(relit, tmp_path, tmp_path / "scan", "0-3").refused("--video-frames 0-3: ")
    assert files_in(tmp_path) == before
