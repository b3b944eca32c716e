"""Names that are too long, text that is nested too deeply, and characters that cannot be printed: one sentence, without a traceback."""

import numpy as np
import pytest

from tests.scenes.captures import edit_manifest, make_scene, write_capture, write_image

DEEP = 100_000


def sentence(outcome) -> str:
    assert (outcome.code, outcome.out) == (2, "") and outcome.err.startswith("relit: ") and outcome.err.count("\n") == 1, outcome
    return outcome.err


def test_a_name_with_a_nul_and_half_a_character(relit, tmp_path):
    write_capture(tmp_path / "cap", make_scene(size=8, lights=5))
    edit_manifest(tmp_path / "cap", name="a\0b\ud800")
    assert "capture.json: name: has a control character (U+0000): leave" in sentence(relit("info", tmp_path / "cap"))


@pytest.mark.parametrize("command", [["info"], ["solve", "--out", "OUT"]], ids=["info", "solve"])
def test_a_name_that_is_too_long(relit, tmp_path, command):
    write_capture(tmp_path / "cap", make_scene(size=8, lights=5))
    edit_manifest(tmp_path / "cap", mask="x" * 500 + ".png")
    arguments = [str(part).replace("OUT", str(tmp_path / "out")) for part in command]
    assert "file name too long" in sentence(relit(*arguments, tmp_path / "cap"))
    assert "ile name too long" in sentence(relit(*arguments, tmp_path / ("y" * 5000)))


@pytest.mark.parametrize(("length", "words"), [(500, "file name too long"), (5000, "a.lp: line 2: the image name has 5004 characters")])
def test_a_name_of_an_lp_file_that_is_too_long(relit, tmp_path, length, words):
    write_image(tmp_path / "a.png", np.zeros((4, 4, 3), np.uint8))
    (tmp_path / "a.lp").write_text(f"1\n{'x' * length}.png 0 0 1\n")
    assert words in sentence(relit("import", "lp", tmp_path, tmp_path / "out"))


@pytest.mark.parametrize("text", ["[" * DEEP, '{"a":' * DEEP, "[" * DEEP + "]" * DEEP], ids=["lists", "objects", "closed"])
def test_json_that_is_nested_too_deeply(relit, tmp_path, text):
    write_capture(tmp_path / "cap", make_scene(size=8, lights=5))
    for name in ("capture.json", "keys.json", "calibration.json"):
        (tmp_path / name).write_text(text)
    assert "capture.json: is nested too deeply" in sentence(relit("info", tmp_path))
    assert "keys.json: is nested too deeply" in sentence(
        relit("relight", tmp_path / "cap", "--keys", tmp_path / "keys.json", "--out", tmp_path / "f.####.exr", "--device", "cpu"))
    (tmp_path / "cap" / ".relit").mkdir()
    (tmp_path / "cap" / ".relit" / "files.json").write_text(text)  # what is remembered of the files may be damaged
    outcome = relit("solve", tmp_path / "cap", "--out", tmp_path / "out", "--method", "lambert", "--device", "cpu")
    assert outcome.code == 0, outcome.err


@pytest.mark.long
def test_toml_that_is_nested_too_deeply(relit, tmp_path):
    (tmp_path / "relit.toml").write_text(f"a = {'[' * DEEP}{']' * DEEP}")
    assert "relit.toml: is nested too deeply" in sentence(relit("serve", "--config", tmp_path / "relit.toml"))
