"""Every bad input: exit code 2, one sentence that names the file or the field, and nothing half-written anywhere."""

import os
import tempfile
from pathlib import Path

import numpy as np
import pytest

from kernels import device as devices
from tests.scenes.captures import edit_frame, edit_manifest, files_in, make_scene, write_capture, write_exr, write_image
from tests.service.full_disk import files_of_at_most

SCENE = make_scene(size=8, lights=5)
MEMORY = ".relit/files.json"
"""Remembered hashes: the one file that a refused run may leave in a capture."""


def cut(path: Path, keep: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data))])


def image_with(path: Path, value: float) -> None:
    image = SCENE.images[2].copy()
    image[3, 4] = value
    write_exr(path, image)


def coplanar(cap: Path) -> None:
    for index, x in enumerate((-0.5, -0.2, 0.1, 0.3, 0.6)):
        edit_frame(cap, index, light={"type": "distant", "direction": [x, 0.0, 1.0], "irradiance": [1, 1, 1]})


def one_pixel(cap: Path) -> None:
    for name in [path.name for path in cap.glob("*.exr")] + ["mask.png"]:
        (cap / name).unlink()
    write_capture(cap, make_scene(size=1, lights=5))


def in_place_of_capture(cap: Path) -> None:
    for path in cap.iterdir():
        path.unlink()
    cap.rmdir()
    cap.write_text("not a folder")


BAD = {
    "missing file": (lambda cap: (cap / "002.exr").unlink(), "capture.json: frames[2].image: 002.exr is not in the folder"),
    "missing mask": (lambda cap: (cap / "mask.png").unlink(), "capture.json: mask: mask.png is not in the folder"),
    "truncated EXR": (lambda cap: cut(cap / "002.exr", 0.9), "002.exr: is truncated: "),
    "half an EXR header": (lambda cap: cut(cap / "002.exr", 0.1), "002.exr: is damaged or truncated"),
    "empty EXR": (lambda cap: cut(cap / "002.exr", 0), "002.exr: is not an OpenEXR file"),
    "truncated PNG": (lambda cap: cut(cap / "mask.png", 0.9), "mask.png: is truncated"),
    "wrong size": (lambda cap: write_exr(cap / "002.exr", np.ones((8, 9, 3))), "002.exr: is 9x8, camera.resolution says 8x8"),
    "wrong mask size": (lambda cap: write_image(cap / "mask.png", np.full((9, 9), 255, np.uint8)), "mask.png: is 9x9"),
    "NaN": (lambda cap: image_with(cap / "002.exr", np.nan),
            "002.exr: 1 pixel is not finite (NaN or infinity), the first"),
    "infinity": (lambda cap: image_with(cap / "002.exr", np.inf), "002.exr: 1 pixel is not finite"),
    "negative": (lambda cap: image_with(cap / "002.exr", -0.01), "002.exr: 1 pixel is negative, the first at row 3, column 4"),
    "zero direction": (lambda cap: edit_frame(cap, 2, light={"type": "distant", "direction": [0, 0, 0], "irradiance": [1, 1, 1]}),
                       "capture.json: frames[2].light.direction: has zero length"),
    "two frames of one name": (lambda cap: edit_frame(cap, 2, image="001.exr"),
                               "capture.json: frames[2].image: 001.exr is already the image"),
    "empty mask": (lambda cap: write_image(cap / "mask.png", np.zeros((8, 8), np.uint8)), "mask.png: the mask is empty"),
    "coplanar lights": (coplanar, "capture.json: frames[].light.direction: all 5 lights lie in"),
    "two lights": (lambda cap: edit_manifest(cap, frames=lambda frames: frames[:2]), "frames: 2 lit by a distant light: a normal"),
    "one pixel": (one_pixel, "capture.json: camera.resolution: is 1x1"),
    "unknown key": (lambda cap: edit_manifest(cap, color="red"), "capture.json: color: is not a known key"),
    "not JSON": (lambda cap: (cap / "capture.json").write_text("{"), "capture.json: is not JSON"),
    "no manifest": (lambda cap: (cap / "capture.json").unlink(), "cap: holds no capture.json"),
    "a file for a folder": (in_place_of_capture, "cap: there is no such folder"),
    "a folder for a file": (lambda cap: ((cap / "002.exr").unlink(), (cap / "002.exr").mkdir()), "002.exr: is a directory"),
    "a path outside": (lambda cap: edit_frame(cap, 2, image="../002.exr"), "../002.exr leads out of the capture's folder"),
    "unknown format": (lambda cap: edit_frame(cap, 2, image="capture.json"), "capture.json: has an unknown suffix"),
    "dark of another size": (lambda cap: (write_exr(cap / "d.exr", np.zeros((2, 2))), edit_manifest(cap, dark="d.exr")),
                             "d.exr: is 2x2"),
    "NaN in the dark frame": (lambda cap: (write_exr(cap / "d.exr", np.full((8, 8), np.nan)), edit_manifest(cap, dark="d.exr")),
                              "d.exr: 64 pixels are not finite"),
}
MAY_RELIGHT = {"coplanar lights", "two lights", "one pixel", "empty mask"}
"""Faults that stop a solver but not a sum of images."""


@pytest.mark.parametrize(("command", "fault"), [(command, fault) for command in ("solve", "info", "relight") for fault in BAD
                                                if command != "relight" or fault not in MAY_RELIGHT])
def test_bad_captures(relit, tmp_path, command, fault):
    cap, out = tmp_path / "cap", tmp_path / "out"
    write_capture(cap, SCENE)
    spoil, words = BAD[fault]
    spoil(cap)
    sky = write_exr(tmp_path / "sky.exr", np.ones((4, 8, 3)))
    before = files_in(tmp_path)
    arguments = {"solve": ["--out", out], "info": [], "relight": ["--environment", sky, "--out", out / "a.##.exr"]}[command]
    outcome = relit(command, cap, *arguments)
    assert outcome.code == 2 and outcome.err.startswith("relit: ") and outcome.err.count("\n") == 1 and words in outcome.err, outcome
    assert outcome.err.count(str(cap)) <= 1  # the path is said once
    assert files_in(tmp_path) - {f"cap/{MEMORY}"} == before
    assert not out.exists()


@pytest.mark.parametrize("command", ["solve", "info", "depth"])
def test_all_faults_of_a_manifest_are_listed(relit, tmp_path, command):
    write_capture(tmp_path / "cap", SCENE)
    edit_manifest(tmp_path / "cap", saturation=-1, colour="red")
    edit_frame(tmp_path / "cap", 2, exposure_s=0)
    arguments = [] if command == "info" else ["--out", tmp_path / "out"]
    outcome = relit(command, tmp_path / "cap", *arguments)
    assert (outcome.code, outcome.out) == (2, "") and not (tmp_path / "out").exists()
    expected = ("saturation: is -1: ", "frames[2].exposure_s: is 0: ", "colour: is not a known key", "frames[0].exposure_s: is missing")
    for line, fault in zip(outcome.err.splitlines(), expected, strict=True):
        assert line.startswith(f"relit: {tmp_path}/cap/capture.json: {fault}")
    write_capture(tmp_path / "other", SCENE)
    for name in ("001.exr", "003.exr"):
        (tmp_path / "other" / name).unlink()
    write_image(tmp_path / "other" / "mask.png", np.full((9, 9), 255, np.uint8))
    outcome = relit(command, tmp_path / "other", *arguments)
    assert outcome.err.splitlines() == [f"relit: {tmp_path}/other/{fault}" for fault in (
        "mask.png: is 9x9, camera.resolution says 8x8", "capture.json: frames[1].image: 001.exr is not in the folder",
        "capture.json: frames[3].image: 003.exr is not in the folder")]


BAD_RELIGHT = {
    "environment of another shape": ({"sky": np.ones((4, 9, 3))}, {}, "sky.exr: is 9x4: a lat-long map is twice as wide as high"),
    "square environment": ({"sky": np.ones((4, 4, 3))}, {}, "sky.exr: is 4x4: a lat-long map is twice as wide as high"),
    "NaN in the environment": ({"sky": np.full((4, 8, 3), np.nan)}, {}, "sky.exr: 32 pixels are not finite"),
    "negative environment": ({"sky": np.full((4, 8, 3), -1.0)}, {}, "sky.exr: 32 pixels are negative"),
    "no environment": ({}, {"environment": "none.exr"}, "none.exr: no such file or directory"),
    "environment of another kind": ({}, {"environment": "sky.png"}, "sky.png: an environment is a lat-long .exr or .hdr"),
    "frames backwards": ({}, {"frames": "5-3"}, "--frames 5-3: runs backwards: give 3-5"),
    "frames in words": ({}, {"frames": "one"}, "--frames one: give a number, or first-last such as 1-24"),
    "negative frame": ({}, {"frames": "-3"}, "--frames -3: give a number"),
    "no number in the name": ({}, {"out": "out/a.exr"}, "a.exr: the file name needs one run of #"),
    "two numbers in the name": ({}, {"out": "out/a.#.##.exr"}, "a.#.##.exr: the file name needs one run of #"),
    "a number in the folder": ({}, {"out": "out.##/a.##.exr"}, "the file name needs one run of #"),
    "wrong suffix": ({}, {"out": "out/a.##.png"}, "a.##.png: frames are OpenEXR: end the name in .exr"),
    "over its own images": ({}, {"out": "cap/###.exr"}, "001.exr is an input: choose another folder or name"),
    "more frames than a disk": ({}, {"frames": "1-99999999999"}, "--frames 1-99999999999: asks for 99999999999 frames"),
    "endless spin": ({}, {"spin-degrees": "inf"}, "relit: --spin-degrees: is Infinity"),
    "no spin": ({}, {"spin-degrees": "nan"}, "relit: --spin-degrees: is NaN"),
    "a file for a folder": ({}, {"out": "file/a.##.exr"}, "cannot write file/a.01.exr: not a directory"),
    "two numbers in the environment": ({}, {"environment": "sky.#.##.exr"}, "sky.#.##.exr: the file name of a sequence has one run of #"),
    "an environment of a sequence": ({}, {"environment": "sky.##.exr"}, "frame 1 has no map: sky.01.exr is not there"),
    "over its environment": ({}, {"environment": "env/a.##.exr", "out": "env/a.##.exr"}, "frame 1 has no map: env/a.01.exr"),
    "no keys": ({}, {"keys": "none.json"}, "cannot read none.json: no such file"),
    "far too bright": ({}, {"exposure": "99"}, "relit: --exposure: is 99.0: input should be less than or"),
    "not a number of stops": ({}, {"exposure": "nan"}, "relit: --exposure: is NaN"),
    "a layer without maps": ({}, {"aov": "beauty,normal"}, "--aov normal needs --maps DIR"),
    "confidence without maps": ({}, {"aov": "confidence"}, "--aov confidence needs --maps DIR"),
    "an unknown layer": ({}, {"aov": "beauty,shadow"}, 'relit: --aov, value 2: is "shadow": '),
    "maps for nothing": ({}, {"maps": "cap"}, "cap/maps.exr: is not there: run `relit solve` first"),
    "no maps there": ({}, {"maps": "cap", "aov": "normal"}, "cap/maps.exr: is not there: run `relit solve` first"),
    "another colour space": ({}, {"color-space": "srgb_texture"}, "--color-space: is srgb_texture: give a scene-linear colour space"),
    "another compression": ({}, {"compression": "jpeg"}, "'jpeg' is not one of 'zip', 'piz', 'dwaa'"),
    "other weights": ({}, {"weights": "even"}, "'even' is not one of 'kernel', 'cells', 'smooth'"),
    "smooth weights in one plane": ({"plane": True}, {"weights": "smooth"}, "smooth weighting needs lights that are not all in one plane"),
    "a sheet of another kind": ({}, {"sheet": "s.jpg"}, "--sheet s.jpg: a contact sheet is a PNG"),
    "a sheet over the mask": ({}, {"sheet": "cap/mask.png"}, "--sheet cap/mask.png: cap/mask.png is an input"),
    "a report over the manifest": ({}, {"report": "cap/capture.json"}, "--report cap/capture.json: cap/capture.json is an input"),
    "a report below a file": ({}, {"report": "file/r.json"}, "cannot write file/r.json: not a directory"),
}


@pytest.mark.parametrize("fault", BAD_RELIGHT)
def test_bad_relights(relit, tmp_path, monkeypatch, fault):
    monkeypatch.chdir(tmp_path)
    write_capture(tmp_path / "cap", SCENE)
    (tmp_path / "file").write_text("")
    images, options, words = BAD_RELIGHT[fault]
    if "plane" in images:
        coplanar(tmp_path / "cap")
    write_exr(tmp_path / "sky.exr", images.get("sky", np.ones((4, 8, 3))))
    before = {name: (tmp_path / name).read_bytes() for name in files_in(tmp_path)}
    given = {"environment": "sky.exr", "out": "out/a.##.exr", "frames": "1-2", **options}
    relit("relight", "cap", *[part for name, value in given.items() for part in (f"--{name}", value)]).refused(words)
    after = files_in(tmp_path)
    assert {name for name in after if not name.startswith("cap/.relit/")} == set(before)
    assert all((tmp_path / name).read_bytes() == content for name, content in before.items())


@pytest.fixture
def relit_as_nobody(relit):
    """Run `relit ARGS` without the superuser's leave to pass over permissions."""
    import service.captures.info
    import service.cli.commands.captures
    import service.relight.relight
    import service.solve.solve  # noqa: F401  (from folders that may not be nobody's to read)

    devices.names()

    def run(*arguments):
        user = os.geteuid()
        if user == 0:
            os.seteuid(65534)
        try:
            return relit(*arguments)
        finally:
            os.seteuid(user)

    return run


@pytest.fixture
def open_folder():
    """A folder that every user may enter, which pytest's own is not."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o777)
        yield Path(name)


@pytest.mark.parametrize(("command", "locked", "mode", "words"), [
    ("info", "", 0o000, "cap: permission denied"),
    ("solve", "", 0o000, "cap: permission denied"),
    ("solve", "002.exr", 0o000, "002.exr: permission denied"),
    ("info", "capture.json", 0o000, "capture.json: permission denied"),
    ("solve", "", 0o555, "cap/.relit: permission denied"),  # it can be read, but holds no cache; --cache says where to
])
def test_what_may_not_be_read_or_written(relit_as_nobody, open_folder, command, locked, mode, words):
    cap = write_capture(open_folder / "cap", SCENE)
    before = files_in(open_folder)
    (cap / locked).chmod(mode)
    arguments = ["--out", str(open_folder / "out")] if command == "solve" else []
    done = relit_as_nobody(command, cap, *arguments)
    (cap / locked).chmod(0o755)
    assert done.refused(words).startswith("relit: cannot ")
    assert files_in(open_folder) == before


def test_frames_into_a_locked_folder_are_refused_before_any_work(relit_as_nobody, open_folder):
    cap, out = write_capture(open_folder / "cap", SCENE), open_folder / "out"
    sky = write_exr(open_folder / "sky.exr", np.ones((4, 8, 3)))
    out.mkdir(mode=0o555)
    arguments = ["relight", cap, "--environment", sky, "--out", out / "a.##.exr", "--cache", open_folder / "cache"]
    relit_as_nobody(*arguments).refused(f"cannot write {out}/a.01.exr: permission denied")
    assert not (open_folder / "cache").exists() and files_in(out) == set()


@pytest.mark.parametrize("arguments", [("solve", "cap", "--out"), ("view", "cap", "--out"), ("publish", "cap", "--as", "web", "--to"),
                                       ("basis", "cap", "--out")])
def test_results_below_a_file_are_refused_before_any_work(relit, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    write_capture(tmp_path / "cap", SCENE)
    before = files_in(tmp_path)
    (tmp_path / "file").write_text("")
    relit(*arguments, "file/out.exr", "--cache", "cache").refused("cannot write file/out.exr: not a directory")
    assert files_in(tmp_path) == before | {"file"}


@pytest.mark.parametrize(("arguments", "words"), [
    (("solve", "none", "--out", "file"), "cannot write file: not a directory"),
    (("depth", "none", "--out", "file"), "cannot write file: not a directory"),
    (("basis", "none", "--out", "folder"), "cannot write folder: is a directory"),
    (("calibrate", "tof", "none", "--out", "folder"), "cannot write folder: is a directory")])
def test_files_for_folders_and_folders_for_files_are_refused_before_any_work(relit, tmp_path, monkeypatch, arguments, words):
    """The input, which is not there, would be refused first by the work."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    relit(*arguments).refused(words)


@pytest.mark.parametrize(("stage", "limit", "words"), [
    ("stack", 2500, "cannot make the stack cache"),
    ("maps", 2000, "cannot write"),
    ("frames", 400, "cannot write"),
])
def test_no_disk_space(relit, tmp_path, stage, limit, words):
    cap, out = tmp_path / "cap", tmp_path / "out"
    write_capture(cap, SCENE)
    sky = write_exr(tmp_path / "sky.exr", np.ones((4, 8, 3)))
    arguments = ["relight", cap, "--environment", sky, "--out", out / "a.##.exr", "--frames", "1-3"] if stage == "frames" else \
        ["solve", cap, "--out", out]
    # the compiled kernels, and except in the first case the stack, are there already: what fails is the file that is meant
    assert relit(*[str(a).replace(str(out), str(tmp_path / "warm")) for a in arguments], "--cache", tmp_path / "cache").code == 0
    cache = tmp_path / "fresh" if stage == "stack" else tmp_path / "cache"
    before = files_in(tmp_path)
    with files_of_at_most(limit):
        done = relit(*arguments, "--cache", cache)
    assert done.refused(str(cache if stage == "stack" else out)).startswith(f"relit: {words}")
    assert files_in(tmp_path) == before


DEEP = 100_000


def test_a_name_with_a_nul_and_half_a_character_and_toml_that_is_nested_too_deeply(relit, tmp_path):
    write_capture(tmp_path / "cap", make_scene(size=8, lights=5))
    edit_manifest(tmp_path / "cap", name="a\0b\ud800")
    relit("info", tmp_path / "cap").refused("capture.json: name: has a control character (U+0000): leave")
    (tmp_path / "relit.toml").write_text(f"a = {'[' * DEEP}{']' * DEEP}")
    relit("serve", "--config", tmp_path / "relit.toml").refused("relit.toml: is nested too deeply")


@pytest.mark.parametrize("command", [["info"], ["solve", "--out", "OUT"]], ids=["info", "solve"])
def test_a_name_that_is_too_long(relit, tmp_path, command):
    write_capture(tmp_path / "cap", make_scene(size=8, lights=5))
    edit_manifest(tmp_path / "cap", mask="x" * 500 + ".png")
    arguments = [str(part).replace("OUT", str(tmp_path / "out")) for part in command]
    relit(*arguments, tmp_path / "cap").refused("file name too long")
    relit(*arguments, tmp_path / ("y" * 5000)).refused("ile name too long")


@pytest.mark.parametrize(("length", "words"), [(500, "file name too long"), (5000, "has 5004 characters")])
def test_a_name_of_an_lp_file_that_is_too_long(relit, tmp_path, length, words):
    write_image(tmp_path / "a.png", np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "a.lp").write_text(f"1\n{'x' * length}.png 0 0 1\n")
    relit("import", "lp", tmp_path, tmp_path / "out").refused(words)


@pytest.mark.parametrize("text", ["[" * DEEP, '{"a":' * DEEP, "[" * DEEP + "]" * DEEP], ids=["lists", "objects", "closed"])
def test_json_that_is_nested_too_deeply(relit, tmp_path, text):
    write_capture(tmp_path / "cap", make_scene(size=8, lights=5))
    for name in ("capture.json", "keys.json", "calibration.json"):
        (tmp_path / name).write_text(text)
    relit("info", tmp_path).refused("capture.json: is nested too deeply")
    lit = relit("relight", tmp_path / "cap", "--keys", tmp_path / "keys.json", "--out", tmp_path / "f.####.exr", "--device", "cpu")
    lit.refused("keys.json: is nested too deeply")
    (tmp_path / "cap" / ".relit").mkdir()
    (tmp_path / "cap" / ".relit" / "files.json").write_text(text)  # what is remembered of the files may be damaged
    relit("solve", tmp_path / "cap", "--out", tmp_path / "out", "--method", "lambert", "--device", "cpu").well()
