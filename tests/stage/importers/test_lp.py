"""RTI .lp files as captures."""

import shutil

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.errors import ImageError, ManifestError, StorageError
from stage.importers import lp
from stage.importers.guess import guess
from tests.scenes.captures import files_in, nothing_written, write_exr, write_image


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
