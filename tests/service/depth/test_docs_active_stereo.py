"""What docs/active_stereo.md says is run: its JSON is a manifest, and the commands have the options."""

import json
import re
from pathlib import Path

from kernels.status import Status
from stage.capture.manifest import read_manifest

DOCS = (Path(__file__).resolve().parents[3] / "docs" / "active_stereo.md").read_text(encoding="utf-8")


def test_the_json_is_a_manifest(tmp_path):
    code, = re.findall(r"```json\n(.*?)```", DOCS, re.DOTALL)
    (tmp_path / "capture.json").write_text(code, encoding="utf-8")
    manifest = read_manifest(tmp_path / "capture.json")
    assert len(manifest.other_cameras) == 1 and sum(frame.stereo is not None for frame in manifest.frames) == 2
    assert json.loads(code)["frames"][2]["light"]["type"] == "distant"


def test_the_commands_have_the_options(relit):
    lines = [line.split("#")[0] for line in DOCS.splitlines() if line.startswith("relit ")]
    assert {line.split()[1] for line in lines} >= {"depth", "solve", "join"}
    for line in lines:
        shown = relit(*[word for word in line.split()[1:3] if re.fullmatch("[a-z]+", word) and word != "head"], "--help").out
        for option in re.findall(r"--[a-z-]+", line):
            assert option in shown, line


def test_the_statuses_exist():
    named = re.findall(r"^\| `(\w+)` \|", DOCS, re.MULTILINE)
    assert len(named) == 5 and {name.upper() for name in named} <= set(Status.__members__)
