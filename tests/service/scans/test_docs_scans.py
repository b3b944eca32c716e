"""What docs/scans.md says is read by the program: its JSON, and the options of its commands."""

import json
import re
from pathlib import Path

from service.requests.base.options import options_of
from service.requests.register import FuseRequest, RegisterRequest
from stage.sets.scan_set import ScanSet

DOCS = (Path(__file__).resolve().parents[3] / "docs" / "scans.md").read_text(encoding="utf-8")


def test_the_json_is_read():
    code, = re.findall(r"```json\n(.*?)```", DOCS, re.DOTALL)
    assert ScanSet.model_validate(json.loads(code)).turntable is not None


def test_the_options_of_the_table_exist():
    named = set(re.findall(r"^\| `(--[a-z-]+)", DOCS, re.MULTILINE))
    assert named == {"--poses", "--turntable", "--reference", "--markers", "--board", "--cache", "--memory-gb",
                     "--tiles", "--voxel-m", "--texture-faces", "--join-normals", "--misplaced"}
    assert named <= {option.flag for request in (RegisterRequest, FuseRequest) for option in options_of(request)}
