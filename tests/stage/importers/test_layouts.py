"""DiLiGenT objects, RTI .lp files and calibrations of OpenCV as captures."""

import json
import shutil

import cv2
import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.capture.projector import UncalibratedProjector
from stage.errors import ImageError, ManifestError, StorageError
from stage.importers import diligent, lp
from stage.importers.guess import guess
from stage.importers.opencv_file import read_matrices
from stage.importers.pattern_order import GrayStack
from stage.importers.patterns import PatternImages, import_gray
from tests.scenes.captures import files_in, nothing_written, write_exr, write_image

NAMES = ["001.png", "002.png", "003.png", "004.png"]
DIRECTIONS = [(0, 0, 1), (0.5, 0, 1), (0, 0.5, 1), (-0.5, -0.25, 1)]
INTENSITIES = [(1, 1, 1), (2, 1, 0.5), (0.5, 1, 2), (1.5, 1.5, 1.5)]
K1, D1 = np.array([[800.0, 0, 319.5], [0, 810, 239.5], [0, 0, 1]]), np.array([-0.1, 0.02, 0.001, -0.002, 0.003])
K2, D2 = np.array([[1100.0, 0, 400], [0, 1090, 299], [0, 0, 1]]), np.array([-0.05, 0.01, 0.0, 0.001, 0.0])
R, T = cv2.Rodrigues(np.array([0.05, -0.2, 0.02]))[0], np.array([[-250.0], [30.0], [10.0]])
FILES = {"moreno": ("cam_K", "cam_kc", "proj_K", "proj_kc", "R", "T"),
         "kamino": ("cam_int", "cam_dist", "proj_int", "proj_dist", "rotation", "translation"),
         "stereo": ("M1", "D1", "M2", "D2", "R", "T")}


def table(rows) -> str:
    return "".join(" ".join(f"{value:g}" for value in row) + "\n" for row in rows)


@pytest.fixture
def object_folder(tmp_path):
    """A DiLiGenT object of 5 by 4 pixels."""
    folder = tmp_path / "catPNG"
    for index, name in enumerate(NAMES):
        write_image(folder / name, np.full((4, 5, 3), 1000 * (index + 1), np.uint16))
    write_image(folder / "mask.png", np.full((4, 5), 255, np.uint8))
    (folder / "filenames.txt").write_text("\n".join(NAMES) + "\n")
    (folder / "light_directions.txt").write_text(table(DIRECTIONS))
    (folder / "light_intensities.txt").write_text(table(INTENSITIES))
    return folder


def test_a_diligent_object_in_place(object_folder):
    before = files_in(object_folder)
    path = diligent.import_folder(object_folder, object_folder)
    assert path == object_folder / "capture.json"
    assert files_in(object_folder) == before | {"capture.json"}
    capture = Capture.open(object_folder)
    assert (capture.name, capture.manifest.color_space, capture.camera.resolution) == ("catPNG", "lin_rec709_scene", (5, 4))
    assert '"color_space": "lin_rec709_scene"' in path.read_text()
    assert capture.manifest.irradiance_scale == "relative"  # the intensities have no absolute scale
    for frame, name, direction, intensity in zip(capture.manifest.frames, NAMES, DIRECTIONS, INTENSITIES, strict=True):
        assert frame.image == name
        assert np.allclose(frame.light.direction, np.array(direction) / np.linalg.norm(direction))
        assert np.allclose(frame.light.irradiance, intensity)


def test_a_diligent_object_elsewhere(object_folder, tmp_path):
    diligent.import_folder(object_folder, tmp_path / "new" / "cat")
    capture = Capture.open(tmp_path / "new" / "cat")
    assert files_in(capture.folder) == {*NAMES, "mask.png", "capture.json"}
    assert "capture.json" not in files_in(object_folder)
    assert (capture.folder / "002.png").read_bytes() == (object_folder / "002.png").read_bytes()
    diligent.import_folder(object_folder, tmp_path / "new" / "cat")  # again changes nothing


def test_without_a_mask(object_folder):
    (object_folder / "mask.png").unlink()
    diligent.import_folder(object_folder, object_folder)
    assert Capture.open(object_folder).mask().all()


@pytest.mark.parametrize(("file", "text", "words"), [
    ("light_directions.txt", "0 0 1\n0 up 1\n0 0 1\n0 0 1\n", r"light_directions\.txt: line 2: '0 up 1' is not three numbers"),
    ("light_directions.txt", "0 0 1\n\n0 1\n0 0 1\n0 0 1\n", r"light_directions\.txt: line 3: has another count of numbers"),
    ("light_directions.txt", "0 0 1\n0 nan 1\n0 0 1\n0 0 1\n", r"light_directions\.txt: line 2: 0 nan 1 is no direction"),
    ("light_directions.txt", "0 0 1\n0 0 1\n0 0 0\n0 0 1\n", r"light_directions\.txt: line 3: 0 0 0 is no direction"),
    ("light_directions.txt", "0 0 1\n", r"light_directions\.txt: has 1 rows, filenames\.txt names 4"),
    ("light_intensities.txt", "", r"light_intensities\.txt: must hold one or three"),
    ("light_intensities.txt", table([(1, 1, 1)] * 3 + [(1, -1, 1)]), r"frames\[3\]\.light\.irradiance\[1\]: is -1\.0"),
    ("light_intensities.txt", table([(1, 1, 1)] * 3 + [(0, 0, 0)]), r"frames\[3\]\.light\.irradiance: is zero in every channel"),
    ("filenames.txt", "001.png\n002.png\n001.png\n004.png\n", r"filenames\.txt: frames\[2\]\.image: 001\.png is already"),
    ("filenames.txt", "001.png\n002.png\n009.png\n004.png\n", r"009\.png is not in the folder"),
    ("filenames.txt", "009.png\n002.png\n003.png\n004.png\n", r"cannot read .*009\.png: no such file"),
    ("filenames.txt", "001.png\n002.png\n../x.png\n004.png\n", r"\.\./x\.png leads out of the folder"),
])
@pytest.mark.parametrize("in_place", [True, False])
def test_bad_rows_are_named_and_nothing_is_written(object_folder, tmp_path, file, text, words, in_place):
    write_image(tmp_path / "x.png", np.zeros((4, 5, 3), np.uint16))
    (object_folder / file).write_text(text)
    with nothing_written(tmp_path, words, ManifestError, StorageError):
        diligent.import_folder(object_folder, object_folder if in_place else tmp_path / "new")


@pytest.mark.parametrize("name", ["filenames.txt", "light_directions.txt", "light_intensities.txt"])
def test_a_missing_table_is_named(object_folder, name):
    (object_folder / name).unlink()
    with pytest.raises(StorageError, match=rf"cannot read .*{name}: no such file"):
        diligent.import_folder(object_folder, object_folder)


def test_an_empty_object(object_folder):
    for name in ("filenames.txt", "light_directions.txt", "light_intensities.txt"):
        (object_folder / name).write_text("\n")
    with pytest.raises(ManifestError, match=r"light_directions\.txt: holds no light"):
        diligent.import_folder(object_folder, object_folder)


def test_what_is_not_as_the_benchmark_has_it_is_said(object_folder, tmp_path):
    """Other rigs are put into its files: eight bits, a mask of another name, a row that was copied."""
    (object_folder / "mask.png").rename(object_folder / "cat_mask.PNG")
    for name in NAMES:
        write_image(object_folder / name, np.full((4, 5, 3), 60, np.uint8))
    (object_folder / "light_directions.txt").write_text(table([*DIRECTIONS[:3], DIRECTIONS[0]]))
    diligent.import_folder(object_folder, tmp_path / "new")
    manifest = Capture.open(tmp_path / "new").manifest
    assert manifest.mask == "cat_mask.PNG" and manifest.color_space == "lin_rec709_scene"
    assert [words.split(":")[0] for words in manifest.assumed] == ["color_space", "frames[].light"]
    assert "8 bits" in manifest.assumed[0] and "001.png and 004.png" in manifest.assumed[1]


def test_another_file_of_that_name_is_not_overwritten(object_folder, tmp_path):
    other = write_image(tmp_path / "new" / "003.png", np.zeros((9, 9), np.uint8))
    kept = other.read_bytes()
    with pytest.raises(ManifestError, match=r"003\.png: is there already and differs"):
        diligent.import_folder(object_folder, tmp_path / "new")
    assert other.read_bytes() == kept
    assert files_in(tmp_path / "new") == {"003.png"}


def rti(folder, lines, *, dtype=np.uint8, suffix="jpg", names=("a 1", "b", "c")):
    """Images and an .lp file of three rows."""
    for name in names:
        path = folder / f"{name}.{suffix}"
        if suffix == "exr":
            write_exr(path, np.full((4, 5, 3), 0.5))
        else:
            write_image(path, np.full((4, 5, 3), 100, dtype))
    (folder / "dome.lp").write_text("\n".join(lines) + "\n")
    return folder


def test_an_rti_folder_with_quoted_names_and_a_mask_of_its_own(tmp_path):
    rti(tmp_path, ["3", '"a 1.jpg" 0 0 1', *GOOD[2:]])
    write_image(tmp_path / "coin_mask.png", np.full((4, 5), 255, np.uint8))
    lp.import_folder(tmp_path, tmp_path)
    manifest = Capture.open(tmp_path).manifest
    assert manifest.frames[0].image == "a 1.jpg" and manifest.mask == "coin_mask.png"


def test_angles_are_no_directions(tmp_path):
    rti(tmp_path, ["4", "a 1.jpg 350 40 1", "b.jpg 20 60 1", "c.jpg 130 80 1", "d.jpg 200 15 1"], names=("a 1", "b", "c", "d"))
    with pytest.raises(ManifestError, match=r"dome\.lp: its columns look like two angles"):
        lp.import_folder(tmp_path, tmp_path)


GOOD = ["3", "a 1.jpg 0.0 0.0 1.0", "b.jpg 0.6 0 0.8", "c.jpg\t0 0.6\t0.8"]


def test_an_rti_capture_with_a_space_in_a_name(tmp_path):
    path = lp.import_folder(rti(tmp_path, GOOD), tmp_path)
    capture = Capture.open(path)
    assert [frame.image for frame in capture.manifest.frames] == ["a 1.jpg", "b.jpg", "c.jpg"]
    assert np.allclose([frame.light.direction for frame in capture.manifest.frames], [(0, 0, 1), (0.6, 0, 0.8), (0, 0.6, 0.8)])
    assert all(frame.light.irradiance == (1, 1, 1) for frame in capture.manifest.frames)
    assert capture.manifest.irradiance_scale == "relative"
    assert (capture.name, capture.camera.resolution) == ("dome", (5, 4))


@pytest.mark.parametrize(("lines", "encoding"), [
    (GOOD[1:], "utf-8"), (["image x y z", *GOOD[1:]], "utf-8-sig"), (GOOD, "utf-16"), (GOOD, "utf-16-le"),
    (["3", *(line.replace(".", ",").replace(",jpg", ".jpg") for line in GOOD[1:])], "utf-8"),
    (["Bild;X;Y;Z", "a 1.jpg;0;0;1", "b.jpg;0,6;0;0,8", "c.jpg;0;0,6;0,8"], "cp1252"),
    (["File Name\tX\tY\tZ", "a 1.jpg\t0\t0\t1", "b.jpg\t0.6\t0\t0.8", "c.jpg\t0\t0.6\t0.8"], "utf-8"),
    (["a 1 0 0 1", "b .6 0 .8", "c 0 .6 .8"], "utf-8")])
def test_other_spellings_of_an_lp_file_are_read_and_guessed(tmp_path, lines, encoding):
    """Guess reads the file as the import does."""
    (rti(tmp_path, []) / "dome.lp").write_bytes("\r\n".join(lines).encode(encoding))
    found = guess(tmp_path)
    assert found.sure and found.arguments[0] == "lp"
    manifest = Capture.open(lp.import_folder(tmp_path, tmp_path)).manifest
    assert [frame.image for frame in manifest.frames] == ["a 1.jpg", "b.jpg", "c.jpg"]
    assert np.allclose([frame.light.direction for frame in manifest.frames], [(0, 0, 1), (0.6, 0, 0.8), (0, 0.6, 0.8)])


def test_strengths_of_an_lp_file_are_taken(tmp_path):
    rti(tmp_path, ["a 1.jpg 0 0 1 1", "b.jpg .6 0 .8 2", "c.jpg 0 .6 .8 .5"])
    manifest = Capture.open(lp.import_folder(tmp_path, tmp_path)).manifest
    assert [frame.light.irradiance[0] for frame in manifest.frames] == [1, 2, 0.5]


@pytest.mark.parametrize("lines", [["4", *GOOD[1:]], ["3", *GOOD[1:3], "d.jpg 0 .6 .8"], ["x y", "1 2"]])
def test_guess_is_not_sure_of_an_lp_file_that_the_import_refuses(tmp_path, lines):
    found = guess(rti(tmp_path, lines))
    with pytest.raises(ManifestError) as refused:
        lp.import_folder(tmp_path, tmp_path)
    assert not found.sure and str(refused.value) in found.assumed


def test_images_that_were_converted_since_are_found_by_their_stems(tmp_path):
    lines = [line.replace(".jpg", ".TIF").replace(".png", ".TIF") for line in GOOD]
    assert lines != GOOD
    folder = rti(tmp_path, lines)
    manifest = Capture.open(lp.import_folder(folder, tmp_path).parent).manifest
    assert all((folder / frame.image).is_file() for frame in manifest.frames)


def test_the_lp_file_itself_may_be_named(tmp_path):
    rti(tmp_path / "a", GOOD)
    shutil.copy(tmp_path / "a" / "dome.lp", tmp_path / "a" / "second.lp")
    with pytest.raises(ManifestError, match=r"holds 2 \.lp files: name the one to import"):
        lp.import_folder(tmp_path / "a", tmp_path / "b")
    lp.import_folder(tmp_path / "a" / "second.lp", tmp_path / "b")
    assert Capture.open(tmp_path / "b").name == "second"


def test_the_folders_of_rtibuilder(tmp_path):
    """The .lp file lies in a folder beside that of the images, and names them by their place on the machine that made it."""
    rti(tmp_path / "coin" / "jpeg-exports", [])
    (tmp_path / "coin" / "jpeg-exports" / "dome.lp").unlink()
    (tmp_path / "coin" / "assembly-files").mkdir()
    (tmp_path / "coin" / "assembly-files" / "dome.lp").write_text(
        "\n".join([GOOD[0], *(f"D:\\RTI\\coin\\jpeg-exports\\{line}" for line in GOOD[1:])]))
    found = guess(tmp_path / "coin")
    assert found.sure and found.arguments == ("lp", str(tmp_path / "coin"))
    with nothing_written(tmp_path, "its images lie in", ManifestError):
        lp.import_folder(tmp_path / "coin" / "assembly-files" / "dome.lp", tmp_path / "coin" / "assembly-files")
    for folder in (tmp_path / "out", tmp_path / "coin"):
        lp.import_folder(tmp_path / "coin", folder)
        assert Capture.open(folder).manifest.frames[0].image == "jpeg-exports/a 1.jpg"


def test_paths_of_another_machine(tmp_path):
    (tmp_path / "sub").mkdir()
    write_image(tmp_path / "sub" / "d.jpg", np.full((4, 5, 3), 100, np.uint8))
    lines = ["4", "C:\\Users\\me\\My Dome\\a 1.jpg 0 0 1", "/home/me/b.jpg 0.6 0 0.8",
             "elsewhere/c.jpg 0 0.6 0.8", "sub\\d.jpg -0.6 0 0.8"]
    lp.import_folder(rti(tmp_path, lines), tmp_path)
    assert [f.image for f in Capture.open(tmp_path).manifest.frames] == ["a 1.jpg", "b.jpg", "c.jpg", "sub/d.jpg"]


@pytest.mark.parametrize(("suffix", "dtype", "space"), [
    ("jpg", np.uint8, "srgb_texture"),
    ("png", np.uint8, "srgb_texture"),
    ("tif", np.uint8, "srgb_texture"),
    ("png", np.uint16, "lin_rec709_scene"),
    ("tif", np.float32, "lin_rec709_scene"),
    ("exr", np.float32, "lin_rec709_scene"),
])
def test_eight_bits_are_taken_as_srgb(tmp_path, suffix, dtype, space):
    lines = [line.replace(".jpg", f".{suffix}") for line in GOOD]
    path = lp.import_folder(rti(tmp_path, lines, dtype=dtype, suffix=suffix), tmp_path)
    assert f'"color_space": "{space}"' in path.read_text()
    assert Capture.open(tmp_path).manifest.color_space == space


@pytest.mark.parametrize(("lines", "words"), [
    ([], r"dome\.lp: holds no light"),
    (["three", *GOOD[1:]], r"dome\.lp: line 1: 'three' is not an image name"),
    (["²", *GOOD[1:]], r"dome\.lp: line 1: '²' is not an image name"),
    (["4", *GOOD[1:]], r"dome\.lp: says 4 lights, holds 3"),
    (["0"], r"dome\.lp: has 1 rows of 1 numbers"),
    (GOOD[1:2] + ["0 0 1", "0 1 1"], r"dome\.lp: line 2: has another count of numbers"),
    (["3", "0 0 1", "0 1 1", "1 0 1"], r"dome\.lp: names no images: relit import olat"),
    (["3", GOOD[1], "b.jpg 0.6 0", GOOD[3]], r"dome\.lp: line 3: has another count of numbers"),
    (["3", "", GOOD[1], "", "b.jpg 0.6 0 up", GOOD[3]], r"dome\.lp: line 5: 'b\.jpg 0\.6 0 up' is not"),
    (["3", GOOD[1], "b.jpg 0 inf 1", GOOD[3]], r"dome\.lp: line 3"),
    (["3", GOOD[1], "b.jpg 0 0 0", GOOD[3]], r"dome\.lp: line 3: 0 0 0 is no direction"),
    (["3", GOOD[1], GOOD[2], GOOD[2]], r"dome\.lp: line 4: names b\.jpg a second time"),
    (["3", GOOD[1], "x.jpg 0 0 1", GOOD[3]], r"x\.jpg is not in the folder"),
    (["3", "x.jpg 0 0 1", *GOOD[2:]], r"x\.jpg is not in the folder"),
    (["3", GOOD[1], "../e.jpg 0 0 1", GOOD[3]], r"\.\./e\.jpg leads out of the folder"),
])
@pytest.mark.parametrize("in_place", [True, False])
def test_bad_lp_files_are_named_and_nothing_is_written(tmp_path, lines, words, in_place):
    rti(tmp_path / "a", lines)
    write_image(tmp_path / "e.jpg", np.zeros((4, 5, 3), np.uint8))
    with nothing_written(tmp_path, words, ManifestError, StorageError):
        lp.import_folder(tmp_path / "a", tmp_path / ("a" if in_place else "b"))


def test_vectors_that_are_as_long_as_positions_are_said(tmp_path):
    rti(tmp_path / "unit", GOOD)
    lp.import_folder(tmp_path / "unit", tmp_path / "unit")
    assert not any("positions" in words for words in Capture.open(tmp_path / "unit").manifest.assumed)
    rti(tmp_path / "mm", ["3", "a 1.jpg 0.0 0.0 300", "b.jpg 210 0 280", "c.jpg 0 240 320"])
    lp.import_folder(tmp_path / "mm", tmp_path / "mm")
    capture = Capture.open(tmp_path / "mm").manifest
    assert any("are 300 to 400 long, as positions are" in words for words in capture.assumed)
    np.testing.assert_allclose(capture.frames[1].light.direction, (0.6, 0, 0.8), atol=1e-12)


def test_no_lp_file(tmp_path):
    with pytest.raises(ManifestError, match=r"holds 0 \.lp files"):
        lp.import_folder(tmp_path, tmp_path)
    with pytest.raises(StorageError, match=r"cannot read .*none: no such file"):
        lp.import_folder(tmp_path / "none", tmp_path)


def test_a_first_image_that_is_none(tmp_path):
    rti(tmp_path, GOOD)
    (tmp_path / "a 1.jpg").write_bytes(b"no image")
    with pytest.raises(ImageError, match=r"a 1\.jpg: cannot be read"):
        lp.import_folder(tmp_path, tmp_path)
    assert "capture.json" not in files_in(tmp_path)


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
