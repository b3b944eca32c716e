"""Layouts that are guessed, and proposals for uploaded files."""

import json
import shlex

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from service.captures.importing import import_chosen, propose
from service.requests.base.import_choices import ImportChoices
from stage.capture.capture import Capture
from stage.errors import ManifestError
from tests.marks import first_short
from tests.scenes import near_lights
from tests.scenes.captures import files_in, make_scene, write_image
from tests.service.captures.test_import_laser import as_text, write_camera, write_scan
from tests.service.captures.test_import_patterns import BLACK, SIZES, SLSTUDIO, WHITE, U, V, gray, wave, write_calibration, write_stack
from tests.service.captures.test_import_tof import ROWS, correlations, histograms, kinect_packet
from tests.service.captures.test_imports import write_near_ps

SCENE = make_scene(8, 4)


def write_images(folder, names=("a1.png", "a2.png", "a10.png", "a11.png")):
    for name, image in zip(names, SCENE.images, strict=True):
        write_image(folder / name, np.round(image / SCENE.images.max() * 60000).astype(np.uint16))
    return list(names)


def text(rows):
    return "".join(" ".join(f"{value:g}" for value in row) + "\n" for row in rows)


def diligent(folder):
    (folder / "filenames.txt").write_text("\n".join(write_images(folder)))
    (folder / "light_directions.txt").write_text(text(SCENE.directions))
    (folder / "light_intensities.txt").write_text(text(SCENE.irradiance))


def lp(folder):
    (folder / "dome.lp").write_text("4\n" + "".join(f"{name} {' '.join(map(str, row))}\n"
                                                    for name, row in zip(write_images(folder), SCENE.directions, strict=True)))


def relightlab(folder):
    write_images(folder)
    (folder / "d.dome").write_text(json.dumps({"directions": [dict(zip("xyz", row, strict=True)) for row in SCENE.directions.tolist()]}))


def near_ps(folder):
    dome = near_lights.dome(8, perspective=True)
    write_near_ps(folder, dome, near_lights.lamps(dome, 4, 3.0, widest=50, exponent=1.4))


def table(folder):
    write_images(folder)
    write_image(folder / "a_mask.png", np.full((8, 8), 255, np.uint8))
    (folder / "lights.txt").write_text("4\n" + text(SCENE.directions))


def slstudio(folder):
    write_calibration(folder / "calibration.xml", SLSTUDIO, **SIZES)
    write_stack(folder, [wave(U - 0.5, 128 / parts, -step / 3) for parts in (16, 1) for step in range(3)], "frameSeq_{}.bmp")


def opencv_gray(folder):
    write_stack(folder, [*(gray(at, bit, inverse=turned) for at, bits in ((U, 11), (V, 10)) for bit in reversed(range(bits))
                           for turned in (False, True)), WHITE, BLACK])


def phase(folder):
    write_stack(folder, [wave(U, period, -step / 4) for period in (16, 18, 21) for step in range(4)])


def tof(folder):
    for name, image in zip((0, 90, 180, 270), correlations([60e6], [0, 90, 180, 270]), strict=True):
        np.save(folder / f"phase{name}.npy", image)
    np.save(folder / "dist.npy", np.ones((ROWS, 32)))


def spad(folder):
    np.save(folder / "h.npy", histograms((4, 5))[1])


def laser(folder):
    write_scan(folder)
    write_camera(folder.parent / "camera.yml")
    as_text(folder)


def kinect(folder):
    (folder / "frame.depth").write_bytes(kinect_packet(np.zeros((9, 424, 512))))
    (folder / "p0.bin").write_bytes(bytes(1302572))


LAYOUTS = {
    "diligent": (diligent, {}), "lp": (lp, {}), "relightlab": (relightlab, {}), "near-lights": (near_ps, {}),
    "olat": (table, {}), "scanner": (slstudio, {}), "opencv-gray": (opencv_gray, {}),
    "phase": (phase, {"WIDTHxHEIGHT": "128x96", "P1,P2,P3": "16,18,21"}), "tof": (tof, {"HZ": "60e6"}),
    "photos": (write_images, {}), "histogram": (spad, {"SECONDS": "1e-9"}), "kinect": (kinect, {}),
    "laser": (laser, {}),
}


@pytest.mark.long
@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_printed_command_makes_the_capture(relit, tmp_path, layout):
    write, capitals = LAYOUTS[layout]
    folder = tmp_path / "My files" / "set"
    folder.mkdir(parents=True)
    write(folder)
    before = files_in(tmp_path)
    out = relit("import", "guess", folder).well()
    assert files_in(tmp_path) == before  # it only looks
    said = dict(line.split(maxsplit=1) for line in out.splitlines())
    assert said["because"] and said["looks"].startswith("like ")
    words = shlex.split(said["run"])
    assert words[:3] == ["relit", "import", layout]
    assert {word for word in words if word in capitals} == set(capitals)
    assumed = [line for line in out.splitlines() if line.startswith("assumed")]
    assert all(any(word.split(",")[0] in line for line in assumed) for word in capitals)  # each is explained
    relit(*(capitals.get(word, word) for word in words[1:])).well()
    assert Capture.open(folder).manifest.frames
    then = shlex.split(said["then"])
    lit = layout in ("diligent", "lp", "relightlab", "near-lights", "olat", "photos")
    assert then[:3] == ["relit", "solve" if lit else "depth", str(folder)]


def test_stripes_without_planes_and_videos_are_told_by_their_names(relit, tmp_path):
    write_scan(tmp_path / "scan")
    out = relit("import", "guess", tmp_path / "scan").well()
    assert f"run      relit import laser {tmp_path}/scan --focal-px FOCAL\n" in out
    assert "then     relit calibrate laser-planes POSE POSE" in out and "assumed  FOCAL is the focal length" in out
    tmp_path = tmp_path / "video"
    tmp_path.mkdir()
    (tmp_path / "scan.mp4").write_bytes(b"its frames are not looked at")
    out = relit("import", "guess", tmp_path).well()
    assert f"relit import gray {tmp_path}/scan.mp4 {tmp_path}/scan-frames --projector" in out
    assert f"then     relit depth {tmp_path}/scan-frames" in out


SURE = ("diligent", "lp", "relightlab", "near-lights", "olat", "scanner", "opencv-gray", "kinect")


@pytest.mark.parametrize("layout", [*sorted(LAYOUTS.keys() - {"kinect"}), pytest.param("kinect", marks=pytest.mark.long)])
def test_auto_imports_what_is_sure_and_nothing_else(relit, tmp_path, layout):
    folder = tmp_path / "set"
    folder.mkdir()
    LAYOUTS[layout][0](folder)
    if layout not in SURE:
        assert f"relit import {layout} {folder}" in relit.refused("import", "auto", folder, tmp_path / "capture")
        assert not (tmp_path / "capture").exists()
        return
    for _ in range(2):
        relit.done("import", "auto", folder, tmp_path / "capture")
    assert Capture.open(tmp_path / "capture").manifest.frames and not (folder / "capture.json").exists()
    assert not (tmp_path / "capture" / "capture.previous.json").exists()  # the same again replaces nothing


def blurred_stripes(sequence, *, inverses, fine_first, gray=1, bits=(8, 7)):
    """Blurred stripes, with noise and gamma, on a surface of two albedos that the projector lights in part, 100 by 128 pixels."""
    random, images, (v, u) = np.random.default_rng(8), [], np.mgrid[:100, :128]
    albedo = np.where((u // 23 + v // 17) % 2, 0.9, 0.3) * ((u > 8) & (v < 92))
    for part in sequence:
        at, count = {"columns": ((u + 6 * np.sin(v / 30)).astype(int) + 10, bits[0]), "rows": (v + 5, bits[1])}.get(part, (None, 1))
        order = range(count) if fine_first else reversed(range(count))
        plain = [np.full(u.shape, part == "white") if at is None else ((at ^ at >> 1) if gray else at) >> bit & 1 > 0 for bit in order]
        turned = {"none": [plain], "blocks": [plain, [~one for one in plain]], "pairs": [[k for one in plain for k in (one, ~one)]],
                  "first": [[k for one in plain for k in (~one, one)]]}
        shown = [one for group in turned[inverses] for one in group] if at is not None else plain
        for one in shown:
            light = albedo * (0.08 + 0.8 * gaussian_filter(one.astype(float), 0.6)) + random.normal(0, 0.004, u.shape)
            images.append(np.clip(255 * np.maximum(light, 0) ** 0.6, 0, 255).astype(np.uint8))
    return images


@first_short(("sequence", "inverses", "fine_first"), [
    ("white,black,columns", "none", False), ("rows,columns,black,white", "pairs", True), ("columns,rows", "blocks", False),
    ("columns", "pairs", False), ("columns,rows,white,black", "first", False), ("rows,black,white", "first", True)])
def test_codes_are_told_from_the_images_alone(relit, tmp_path, sequence, inverses, fine_first):
    """Names say nothing; the command has the order, the inverses and the bits that were shown."""
    for number, image in enumerate(blurred_stripes(sequence.split(","), inverses=inverses, fine_first=fine_first)):
        write_image(tmp_path / f"{number:03d}.png", image)
    out = relit("import", "guess", tmp_path).well()
    run = next(line for line in out.splitlines() if line.startswith("run"))
    assert f"--sequence {sequence} --inverses {inverses}" in run and ("--fine-first" in run) == fine_first
    assert "8 bits of columns" in out if "columns" in sequence else "bits of columns" not in out


@pytest.mark.parametrize("inverses", ["pairs", "first"])
@first_short("even", ["white,black", "black,white"])
def test_codes_on_a_small_object_are_told(relit, tmp_path, even, inverses):
    """The coarse stripes cover an object on an eighth of the image, before darkness, as a whole: all is told by the other stripes."""
    near = np.hypot(*(np.mgrid[:100, :128] - np.array([50, 40])[:, None, None])) < 22
    images = blurred_stripes(["columns", "rows", *even.split(",")], inverses=inverses, fine_first=False, bits=(10, 9))
    for number, image in enumerate(images):
        write_image(tmp_path / f"{number:03d}.png", np.where(near, image, 3).astype(np.uint8))
    out = relit("import", "guess", tmp_path).well()
    if (even, inverses) == ("white,black", "pairs"):
        assert "relit import opencv-gray" in out
    else:
        assert f"--sequence columns,rows,{even} --inverses {inverses}" in out


def test_waves_on_a_small_object_are_told(relit, tmp_path):
    near = np.hypot(*(np.mgrid[:U.shape[0], :U.shape[1]] - np.array([30, 40])[:, None, None])) < 16
    write_stack(tmp_path, [wave(U, period, -step / 4) * near for period in (16, 18, 21) for step in range(4)])
    assert "looks    like phase shifts" in relit("import", "guess", tmp_path).well()


def test_of_projectors_with_as_many_bits_the_one_that_is_taken_is_said(relit, tmp_path):
    images = blurred_stripes(["columns", "rows", "white", "black"], inverses="pairs", fine_first=False, bits=(10, 10))
    for number, image in enumerate(images):
        write_image(tmp_path / f"{number:03d}.png", image)
    out = relit("import", "guess", tmp_path).well()
    assert "--projector 1024x768" in out and "the projector has 1024x768 pixels" in out and "as 800x600 pixels have too" in out


def test_the_principal_point_tells_the_projector(relit, tmp_path):
    """Both 854 and 640 columns have ten bits; the calibration says no size."""
    images = blurred_stripes(["columns", "rows", "white", "black"], inverses="pairs", fine_first=False, bits=(10, 9))
    for number, image in enumerate(images):
        write_image(tmp_path / f"{number:03d}.png", image)
    (tmp_path / "rig.json").write_text(json.dumps({
        "M1": [[200, 0, 64], [0, 200, 50], [0, 0, 1]], "M2": [[700, 0, 322], [0, 700, 400], [0, 0, 1]], "R": np.eye(3).tolist(),
        "T": [150, 0, 0]}))
    out = relit("import", "guess", tmp_path).well()
    assert "--projector 640x480 --calibration" in out and "principal point near the middle" in out


def binary(folder):
    for number, image in enumerate(blurred_stripes(["columns", "rows"], inverses="pairs", fine_first=False, gray=0)):
        write_image(folder / f"{number:03d}.png", image)


@pytest.mark.parametrize(("write", "words"), [
    (binary, "plain binary code, 8 bits of columns and 7 of rows"),
    (lambda folder: [write_image(folder / f"{k}_{side}.png", np.full((6, 8), 9 * k, np.uint8)) for k in range(3) for side in "lr"],
     "two cameras"),
    (lambda folder: [write_image(folder / f"plane_{k}.png", np.full((6, 8), 9 * k, np.uint8)) for k in range(9)], "coefficient image"),
    (lambda folder: write_image(folder / "sky.hdr", np.ones((8, 16, 3), np.float32)), "environment map"),
    (lambda folder: [write_image(folder / f"m{k}.png", 255 * (np.arange(48).reshape(6, 8) > 9 * k).astype(np.uint8)) for k in range(5)],
     "as masks have")], ids=["binary", "stereo", "planes", "sky", "masks"])
def test_images_that_no_importer_takes_are_told_apart(relit, tmp_path, write, words):
    write(tmp_path)
    assert words in relit.refused("import", "guess", tmp_path)


def test_folders_of_poses_and_images_of_two_sizes(relit, tmp_path):
    for pose in ("a", "b"):
        (tmp_path / "poses" / pose).mkdir(parents=True)
        lp(tmp_path / "poses" / pose)
    relit.done("import", "auto", tmp_path / "poses", tmp_path / "out")
    assert {path.parent.name for path in (tmp_path / "out").glob("*/capture.json")} == {"a", "b"}
    (tmp_path / "mixed").mkdir()
    for k in range(6):
        write_image(tmp_path / "mixed" / f"a{k}.png", np.tile(np.arange(30, dtype=np.uint8) * k, (20 + 10 * (k % 3 == 0), 1)))
    assert "of another size" in relit("import", "guess", tmp_path / "mixed").well()


def test_the_bright_side_of_the_object_tells_a_mirrored_table(relit, tmp_path):
    """Directions with x to the left, as a camera's owner may have them."""
    scene = make_scene(24, 9)
    for number, image in enumerate(scene.images):
        write_image(tmp_path / f"{number}.png", np.round(image / scene.images.max() * 60000).astype(np.uint16))
    (tmp_path / "lights.txt").write_text(text(scene.directions * (-1, 1, 1)))
    relit.done("import", "auto", tmp_path)
    directions = [frame.light.direction for frame in Capture.open(tmp_path).manifest.frames]
    assert np.allclose(directions, scene.directions, atol=1e-5)


def test_a_table_of_other_images_is_none(relit, tmp_path):
    """The light table of a result, as `relit basis` writes it, beside other images; of which some are missing, the guess is not sure."""
    names = write_images(tmp_path)
    named = {"lights": [{"image": name, "direction": row} for name, row in zip(names, SCENE.directions.tolist(), strict=True)]}
    (tmp_path / "basis.exr.json").write_text(json.dumps(named))
    assert "sure     yes" in relit("import", "guess", tmp_path).well()
    (tmp_path / "a1.png").unlink()
    said = relit("import", "guess", tmp_path).well()
    assert "1 images of basis.exr.json are not there, a1.png the first" in said and "sure     yes" not in said
    for name in names[1:]:
        (tmp_path / name).rename(tmp_path / f"other_{name}")
    relit("import", "guess", tmp_path).refused("which is no layout that relit import knows")


def test_photographs_that_are_there_twice_are_named_unless_a_list_names_one_of_them(relit, tmp_path):
    for number, image in enumerate(make_scene(12, 9).images):
        write_image(tmp_path / f"{number}.png", np.round(image / image.max() * 60000).astype(np.uint16))
        write_image(tmp_path / f"{number}_preview.png", np.round(image[::2, ::2] / image.max() * 60000).astype(np.uint16))
    assert "relit import photos" in (said := relit("import", "guess", tmp_path).well()) and "--images '*.png'" in said
    for number in range(9):
        (tmp_path / f"{number}_preview.png").rename(tmp_path / f"{number}.TIF")
    relit("import", "guess", tmp_path).refused("0.png and 0.TIF are one photograph: choose which")
    (tmp_path / "a.lp").write_text("".join(f"{number}.png 0 .{number} 1\n" for number in range(9)))
    assert "sure     yes" in relit("import", "guess", tmp_path).well()


def test_results_need_no_import(relit, tmp_path):
    for name in ("maps.exr", "report.json"):
        (tmp_path / name).touch()
    relit("import", "guess", tmp_path).refused("is a result of relit, which needs no import: it holds maps.exr, solved maps")


def test_correlations_with_more_words_in_their_names(relit, tmp_path):
    for name, image in zip((0, 90, 180, 270), correlations([60e6], [0, 90, 180, 270]), strict=True):
        np.save(tmp_path / f"phase{name}_avg.npy", image)
    assert "--arrays 'phase*_avg.npy'" in relit("import", "guess", tmp_path).well()


def test_what_is_no_layout_and_what_is_a_capture(relit, tmp_path):
    (tmp_path / "thesis.pdf").write_bytes(b"%PDF")
    write_image(tmp_path / "photo.jpg", np.zeros((4, 4, 3), np.uint8))
    relit("import", "guess", tmp_path).refused("holds 1 .jpg, 1 .pdf, which is no layout that relit import")
    (tmp_path / "capture.json").write_text("{}")
    relit("import", "guess", tmp_path).refused("is a capture already: relit info")


@pytest.mark.parametrize("name", ["light.mat", "calibration.xml", "lights.csv", "a.npy", "b.dome", "c.npz", "d.json"])
def test_damaged_files_are_passed_over(relit, tmp_path, name):
    (tmp_path / name).write_bytes(b"\x93NUMPY damaged")
    outcome = relit("import", "guess", tmp_path)
    assert outcome.code == (0 if name == "b.dome" else 2) and outcome.err.count("\n") == (0 if name == "b.dome" else 1)
    write_images(tmp_path)
    assert f"relit import {'relightlab' if name == 'b.dome' else 'photos'}" in relit("import", "guess", tmp_path).well()


@pytest.mark.parametrize(("layout", "options"), [
    ("gray", {"projector": [64, 32]}), ("phase", {"projector": [64, 32], "periods": [8], "steps": 4})])
def test_a_video_is_left_to_the_machine_of_its_owner(tmp_path, layout, options):
    """The file is no video but for its name: whoever opened it would say so."""
    (tmp_path / "take.mp4").write_bytes(b"nothing")
    with pytest.raises(ManifestError, match=f"take.mp4: is a video: unpack it with relit import {layout} on your machine"):
        import_chosen(tmp_path, ImportChoices(layout=layout, file="take.mp4", options=options), (), "take")
    assert [path.name for path in tmp_path.iterdir()] == ["take.mp4"]


def test_a_video_is_not_proposed(tmp_path):
    (tmp_path / "take.mp4").write_bytes(b"nothing")
    with pytest.raises(ManifestError, match="relit import gray on your machine"):
        propose(tmp_path)
