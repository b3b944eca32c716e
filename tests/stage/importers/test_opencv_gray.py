"""Images in the order of OpenCV's structured light, and calibrations of OpenCV, as captures."""

import json

import cv2
import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.capture.projector import UncalibratedProjector
from stage.errors import ManifestError
from stage.importers.opencv_file import read_matrices
from stage.importers.pattern_order import GrayStack
from stage.importers.patterns import PatternImages, import_gray
from tests.scenes.captures import write_image

K1, D1 = np.array([[800.0, 0, 319.5], [0, 810, 239.5], [0, 0, 1]]), np.array([-0.1, 0.02, 0.001, -0.002, 0.003])
K2, D2 = np.array([[1100.0, 0, 400], [0, 1090, 299], [0, 0, 1]]), np.array([-0.05, 0.01, 0.0, 0.001, 0.0])
R, T = cv2.Rodrigues(np.array([0.05, -0.2, 0.02]))[0], np.array([[-250.0], [30.0], [10.0]])
FILES = {"moreno": ("cam_K", "cam_kc", "proj_K", "proj_kc", "R", "T"),
         "kamino": ("cam_int", "cam_dist", "proj_int", "proj_dist", "rotation", "translation"),
         "stereo": ("M1", "D1", "M2", "D2", "R", "T")}




def import_folder(source, destination, **options):
    return import_gray(source, destination, pictures=PatternImages(**options), gray=GrayStack())


@pytest.fixture
def scan(tmp_path):
    folder = tmp_path / "scan"
    for number in range(len(GrayStack().entries((16, 6)))):
        write_image(folder / f"im{number}.png", np.full((48, 64), number, np.uint8))
    return folder


def write_calibration(path, names=FILES["moreno"], values=(K1, D1[None], K2, D2[None], R, T)):
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in zip(names, values, strict=True):
        file.write(name, value)
    file.release()
    return path


def test_the_order_is_opencvs(scan, tmp_path):
    import_folder(scan, tmp_path / "capture", projector=(16, 6))
    capture = Capture.open(tmp_path / "capture")
    frames = [(frame.image, frame.pattern) for frame in capture.manifest.frames]
    assert [name for name, _ in frames] == [f"im{number}.png" for number in range(16)]
    first, last = frames[0][1], frames[-3][1]
    assert (first.axis, first.bit, first.bits, first.inverse) == ("column", 3, 4, False)
    assert (last.axis, last.bit, last.bits, last.inverse) == ("row", 0, 3, True)
    assert [pattern.code for _, pattern in frames[-2:]] == ["white", "black"]
    assert capture.manifest.projector == UncalibratedProjector(resolution=(16, 6))  # for relit calibrate procam


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
@pytest.mark.parametrize("names", FILES.values(), ids=FILES)
def test_a_calibration_says_where_the_projector_is(scan, tmp_path, suffix, names):
    path = write_calibration(tmp_path / f"calibration{suffix}", names)
    import_folder(scan, scan, projector=(16, 6), calibration=path, unit_m=0.001)
    manifest = Capture.open(scan).manifest
    assert manifest.camera.principal_px == (320.0, 240.0) and manifest.camera.focal_px == (800.0, 810.0)
    assert manifest.camera.distortion.k == (-0.1, 0.02, 0.003) and manifest.camera.distortion.p == (0.001, -0.002)
    points = np.array([[0.1, 0.05, -1.2], [-0.2, 0.1, -0.9]])  # ours, metres
    truth = cv2.projectPoints(points * (1000, -1000, -1000), cv2.Rodrigues(R)[0], T, K2, D2)[0][:, 0] + 0.5
    found, ahead = manifest.projector.project(points)
    assert ahead.all() and np.abs(found - truth).max() < 1e-6


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize(("name", "text"), [
    ("camera.json", json.dumps({"camera_matrix": K1.tolist(), "image_width": 640})),
    ("ros.yaml", "image_width: 640\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [800, 0, 319.5, 0, 810, 239.5, 0, 0, 1]\n")])
def test_calibrations_of_other_programs(tmp_path, name, text, encoding):
    """As ROS writes them, and editors of Windows."""
    (tmp_path / name).write_bytes(text.encode(encoding))
    found = read_matrices(tmp_path / name)
    assert np.array_equal(found["camera_matrix"], K1) and found["image_width"] == 640


def test_plain_lists_in_json(scan, tmp_path):
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({"M1": K1.tolist(), "M2": K2.tolist(), "R": R.tolist(), "T": T.ravel().tolist(), "note": "hello"}))
    import_folder(scan, scan, projector=(16, 6), calibration=path)
    assert Capture.open(scan).manifest.projector.distortion.k == (0, 0, 0)


def test_bad_input_is_named(scan, tmp_path):
    with pytest.raises(ManifestError, match=r"has 16 images .* where these options have 18 patterns"):
        import_folder(scan, scan, projector=(32, 6))
    with pytest.raises(ManifestError, match="holds no translation T"):
        import_folder(scan, scan, projector=(16, 6), calibration=write_calibration(tmp_path / "a.yml", FILES["moreno"][:5],
                                                                                  (K1, D1, K2, D2, R)))
    (tmp_path / "b.yml").write_text("nothing: [")
    with pytest.raises(ManifestError, match=r"b\.yml"):
        import_folder(scan, scan, projector=(16, 6), calibration=tmp_path / "b.yml")
    with pytest.raises(ManifestError, match="suffix must be one of"):
        import_folder(scan, scan, projector=(16, 6), calibration=tmp_path / "b.txt")
    tilted = write_calibration(tmp_path / "c.yml", values=(K1, np.append(D1, [0.1, 0, 0])[None], K2, D2[None], R, T))
    with pytest.raises(ManifestError, match="distortion of the camera must be k1 k2 p1 p2"):
        import_folder(scan, scan, projector=(16, 6), calibration=tilted)
    stretched = write_calibration(tmp_path / "d.yml", values=(K1, D1[None], K2, D2[None], 2 * R, T))
    with pytest.raises(ManifestError, match="not a rotation"):
        import_folder(scan, scan, projector=(16, 6), calibration=stretched)
    assert not (scan / "capture.json").exists()
