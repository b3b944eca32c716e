"""Images of a laser's stripe, with planes as calibration programs write them, from files to depth in two commands."""

import json

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from stage.capture.capture import Capture
from stage.results.depth_maps import DepthMaps
from tests.reference import projector as reference
from tests.scenes.captures import write_image

CAMERA = reference.Device(160, 120, 260.0, (-0.1, 0.02, 0.0), (0.001, -0.0005))
RAYS = reference.pixel_rays(CAMERA)
TRUTH = np.fmax(*(reference.plane_depth(RAYS, (0.0, 0.0, -0.9), (0.1, slope, 1.0)) for slope in (0.3, -0.2)))
"""Two walls that meet, which hide nothing from each other."""
POINTS = RAYS * TRUTH[..., None]
LASER = np.array((0.3, 0.02, 0.0))
NORMALS = [np.array((np.cos(angle), 0.05, np.sin(angle))) / np.hypot(1, 0.05) for angle in np.radians(np.linspace(-10, -27, 12))]
OPENCV = np.diag([1.0, -1.0, -1.0])
"""OpenCV's axes from those of relit, and back."""


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
@pytest.mark.parametrize("write", [as_csv, as_text, as_yaml, as_mat, as_json, as_points])
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
    assert relit("depth", folder, "--out", tmp_path / "out", "--device", "cpu").code == 0
    maps = DepthMaps.read(tmp_path / "out" / "depth.exr")
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
