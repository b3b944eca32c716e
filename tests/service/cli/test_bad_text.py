"""Names that are too long, text that is nested too deeply, and characters that cannot be printed: one sentence, without a traceback."""

import numpy as np
import pytest

from tests.scenes.captures import edit_manifest, make_scene, write_capture, write_image

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


@pytest.mark.parametrize(("length", "words"), [(500, "file name too long"), (5000, "a.lp: line 2: the image name has 5004 characters")])
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
