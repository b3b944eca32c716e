"""docs/inspection.md shows options that exist and JSON files that the schemas take."""

import json
import re
from pathlib import Path

from stage.sets.board import BoardDesign, BoardRegions, BoardScan, GaugeRuns

DOCS = (Path(__file__).resolve().parents[3] / "docs" / "inspection.md").read_text(encoding="utf-8")


def test_the_options_exist(relit):
    shown = relit("inspect-board", "--help").out + relit("submit", "inspect-board", "--help").out
    used = set(re.findall(r"--[a-z][a-z-]+", DOCS))
    assert {"--golden", "--design", "--false-alarm"} <= used
    assert {option for option in used if option not in shown} == set()


def test_the_files_are_valid():
    scan, design, regions, study = (json.loads(text) for text in re.findall(r"```json\n(.*?)```", DOCS, re.DOTALL))
    assert len(BoardScan.model_validate(scan).tiles) == 2
    assert len(GaugeRuns.model_validate(study).runs) == 2
    assert BoardRegions.model_validate(regions).regions[0] == BoardDesign.model_validate(design).regions[0]
    assert BoardDesign.model_validate(design).regions[1].datum == "surround"
