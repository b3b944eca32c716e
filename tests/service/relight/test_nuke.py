"""relit relight --nuke: the script, read and carried out as Nuke would, mixes the frame from the layers of its lights."""

import json
import re

import numpy as np
import OpenEXR

from tests.scenes.captures import make_scene, write_capture

KEYS = {"schema": "relit.keys/1", "lights": [
    {"name": "key, [left] $1", "keys": [{"frame": 1, "direction": [-0.4, 0.2, 0.9], "irradiance": [2, 1.5, 1]}]},
    {"name": "rim", "keys": [{"frame": 1, "direction": [0.4, 0.3, 0.8], "irradiance": [0.3, 0.5, 1]}]},
    {"name": "fill", "keys": [{"frame": 1, "direction": [0, -0.3, 0.9], "irradiance": [0.2, 0.2, 0.2]}]}]}


def words(text: str) -> list[str]:
    """Words of a line of Tcl without substitution: bare, in quotes with backslashes, or in braces."""
    found = re.findall(r'"((?:\\.|[^"\\])*)"|\{([^{}]*)\}|(\S+)', text)
    for quoted, *_ in found:
        assert not re.search(r"(?<!\\)[\[$]", quoted)  # Tcl would replace it
    return [re.sub(r"\\(.)", r"\1", quoted) or braced or bare for quoted, braced, bare in found]


def nodes_of(script: str) -> list[dict]:
    """Return the nodes of a script in their order, each with its inputs, the first of which is the top of the stack."""
    stack: list[dict] = []
    known: dict[str, dict] = {}
    nodes: list[dict] = []
    lines = iter(script.splitlines())
    for line in lines:
        if line.startswith("set "):
            name, place = re.fullmatch(r"set (\w+) \[stack (\d+)\]", line).groups()
            known[name] = stack[-1 - int(place)]
        elif line.startswith("push $"):
            stack.append(known[line[6:]])
        elif line.endswith(" {"):
            node = {"kind": line[:-2], "layers": []}
            for knob in iter(lambda: next(lines), "}"):
                name, *value = words(knob)
                assert len(value) == 1, knob
                node[name] = value[0]
            if node["kind"] != "Root":
                node["from"] = [stack.pop() for _ in range(int(node.get("inputs", 1)))]
                stack.append(node)
            nodes.append(node)
        else:
            assert line == "version 13.0 v1" or line.startswith("add_layer {"), line
    assert len(stack) == 1  # nothing is left over
    return nodes


def carried_out(node: dict, channels: dict[str, np.ndarray], grades: dict[str, float]) -> np.ndarray:
    """[rows, cols, 4] what a node gives."""
    below = [carried_out(each, channels, grades) for each in node["from"]]
    if node["kind"] == "Read":
        return np.stack([channels[name] for name in "RGBA"], axis=-1)
    if node["kind"] == "Shuffle":
        assert node["alpha"] == "black"
        planes = [channels[f"{node['in']}.{name}"] for name in "RGB"]
        return np.stack([*planes, np.zeros_like(planes[0])], axis=-1)
    if node["kind"] == "Grade":
        return below[0] * grades.get(node["name"], 1.0) * np.array([float(value) for value in node["multiply"].split()])
    if node["kind"] == "Merge2":
        assert node["operation"] == "plus"
        return below[0] + below[1]
    assert (node["kind"], node["from0"], node["to0"]) == ("Copy", "rgba.alpha", "rgba.alpha")
    return np.concatenate([below[0][..., :3], below[1][..., 3:]], axis=-1)  # from A, the second input, into B, the first


def test_the_script_mixes_the_frame(relit, tmp_path):
    capture = write_capture(tmp_path / "cap", make_scene(lights=9))
    (tmp_path / "keys.json").write_text(json.dumps(KEYS))
    frames = tmp_path / 'fr"a$1[x]'
    relit.done("relight", capture, "--out", frames / "a.####.exr", "--keys", tmp_path / "keys.json", "--frames", "1001-1002",
               "--aov", "lights", "--nuke", tmp_path / "mix.nk")
    nodes = nodes_of((tmp_path / "mix.nk").read_text())
    root, read, last = nodes[0], nodes[1], nodes[-1]
    assert (root["first_frame"], root["last_frame"], root["fps"]) == ("1001", "1002", "24")
    assert (read["file"], read["first"], read["last"], read["raw"]) == (str(frames / "a.####.exr"), "1001", "1002", "true")
    assert "lin_rec709_scene" in read["label"] and len({node["name"] for node in nodes}) == len(nodes)
    channels = {name: channel.pixels.astype(float) for name, channel in
                OpenEXR.File(str(frames / "a.1001.exr"), separate_channels=True).channels().items()}
    beauty = np.stack([channels[name] for name in "RGBA"], axis=-1)
    half = 2.0**-11 * 4 * beauty.max()  # each of four pictures is rounded to half
    np.testing.assert_allclose(carried_out(last, channels, {}), beauty, atol=half)
    dark = carried_out(last, channels, {"light_rim": 0.0})
    np.testing.assert_allclose(dark[..., :3], beauty[..., :3] - np.stack([channels[f"light_rim.{c}"] for c in "RGB"], axis=-1), atol=half)
    assert [node["name"] for node in nodes if node["kind"] == "Grade"] == ["light_key_left_1", "light_rim", "light_fill"]


def test_a_script_without_layers_is_refused(relit, tmp_path):
    capture = write_capture(tmp_path / "cap", make_scene(lights=9))
    (tmp_path / "keys.json").write_text(json.dumps(KEYS))
    common = ["relight", capture, "--out", tmp_path / "a.####.exr", "--keys", tmp_path / "keys.json", "--frames", "1-2"]
    assert "give --aov lights too" in relit.refused(*common, "--nuke", tmp_path / "a.nk")
    assert "end the name in .nk" in relit.refused(*common, "--aov", "lights", "--nuke", tmp_path / "a.txt")
    assert "--only 1 makes a part" in relit.refused(*common, "--aov", "lights", "--nuke", tmp_path / "a.nk", "--only", "1")
