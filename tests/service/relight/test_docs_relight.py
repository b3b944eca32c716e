"""docs/relight.md: its example runs, and every option of the command is in it."""

import json
import re
from pathlib import Path

import numpy as np

from stage.formats import exr
from tests.scenes.captures import make_scene, write_capture, write_exr

TEXT = (Path(__file__).parents[3] / "docs" / "relight.md").read_text(encoding="utf-8")


def test_the_example_of_light_keys_runs(relit, tmp_path):
    cap = write_capture(tmp_path / "cap", make_scene(size=4, lights=13))
    sky = write_exr(tmp_path / "sky.exr", np.zeros((8, 16, 3)))
    example = re.search(r"```json\n(.*?)```", TEXT, re.DOTALL)[1]
    (tmp_path / "keys.json").write_text(example)
    arguments = ["relight", cap, "--keys", tmp_path / "keys.json", "--environment", sky, "--frames", "1-24"]
    relit.done(*arguments, "--out", tmp_path / "f" / "a.##.exr")
    without = {key: value for key, value in json.loads(example).items() if key not in ("lights", "exposure")}
    (tmp_path / "keys.json").write_text(json.dumps(without))
    assert relit(*arguments, "--out", tmp_path / "g" / "a.##.exr").code == 0
    levels = [exr.read(tmp_path / "g" / f"a.{n:02d}.exr")[0]["R"].astype(float).max() for n in range(1, 25)]
    assert np.allclose(np.array(levels) / levels[0], [*np.linspace(1, 0, 12), *[0] * 7, *[0.5] * 5], rtol=2e-3, atol=1e-6)
    both = exr.read(tmp_path / "f" / "a.24.exr")[0]["R"].astype(float)
    assert both.max() > 2 * levels[-1]  # the light, and one stop


def test_every_option_is_described(relit):
    options = set(re.findall(r"--[a-z-]+", relit("relight", "--help").out)) - {"--help"}
    assert len(options) > 15
    assert {option for option in options if f"`{option}" not in TEXT} == set()
