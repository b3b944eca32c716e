"""Objects of the DiLiGenT benchmark as captures."""


import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.errors import ManifestError, StorageError
from stage.importers import diligent
from tests.scenes.captures import files_in, nothing_written, write_image

NAMES = ["001.png", "002.png", "003.png", "004.png"]
DIRECTIONS = [(0, 0, 1), (0.5, 0, 1), (0, 0.5, 1), (-0.5, -0.25, 1)]
INTENSITIES = [(1, 1, 1), (2, 1, 0.5), (0.5, 1, 2), (1.5, 1.5, 1.5)]


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
