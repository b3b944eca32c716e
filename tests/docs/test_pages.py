"""The README and the pages of docs/ show commands and options that the program has, and JSON and Python that it takes."""

import re
from pathlib import Path
from typing import Any

import pytest

from kernels.status import Status
from stage.capture.manifest import read_manifest
from stage.sets.board import BoardDesign, BoardRegions, BoardScan, GaugeRuns
from stage.sets.paste_limits import PasteLimits
from stage.sets.scan_set import ScanSet
from stage.sets.tolerance_regions import Tolerances
from stage.tof.calibration import Sweep, TofCalibration
from stage.tof.scan import Scan
from tests.service.conftest import made_program

HOME = Path(__file__).parents[2]
PROGRAM: Any = made_program()
PAGES = {path.name: path.read_text(encoding="utf-8") for path in (HOME / "README.md", *sorted((HOME / "docs").glob("*.md")))}
SHOWN = {"inspection.md": [BoardScan, BoardDesign, BoardRegions, PasteLimits, GaugeRuns, Tolerances], "scans.md": [ScanSet],
         "time_of_flight.md": [TofCalibration, Sweep, Scan]}
"""What the JSON blocks of a page are, in their order."""
DESCRIBED = {"relight": set(), "view": {"--out", "--no-align"}}
"""Commands whose pages describe every option, and options that all commands have."""


def blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGES[page], re.DOTALL)


def command_of(words: list[str]) -> tuple[list[str], set[str]]:
    """Return the words that name a command at the beginning of a line, and the options of the command."""
    command, used = PROGRAM, []
    for word in words:
        if word not in getattr(command, "commands", {}):
            break
        command = command.commands[word]
        used.append(word)
    return used, {"--help", *(flag for found in command.params for flag in (*found.opts, *found.secondary_opts))}


@pytest.mark.parametrize("page", PAGES)
def test_commands_have_the_options_that_they_are_shown_with(page):
    for line in re.findall(r"^\s*relit (.*)", PAGES[page].replace("\\\n", " "), re.MULTILINE):
        words = re.split(r"\s[#|&]", line)[0].split()
        used, known = command_of(words)
        assert used and {word.partition("=")[0] for word in words if word.startswith("--")} <= known, line


def test_the_options_in_the_tables_of_scans_exist():
    named = set(re.findall(r"^\| `(--[a-z-]+)", PAGES["scans.md"], re.MULTILINE))
    assert len(named) > 10 and named <= command_of(["register"])[1] | command_of(["fuse"])[1]


@pytest.mark.parametrize("command", DESCRIBED)
def test_every_option_is_described(command):
    options = {flag for flag in command_of([command])[1] if flag.startswith("--")} - {"--help"} - DESCRIBED[command]
    assert len(options) > 4 and {option for option in options if f"`{option}" not in PAGES[f"{command}.md"]} == set()


@pytest.mark.parametrize("page", SHOWN)
def test_the_json_is_read(page):
    for model, text in zip(SHOWN[page], blocks(page, "json"), strict=True):
        model.model_validate_json(text)


def test_the_manifest_and_the_statuses_of_stereo_are_known(tmp_path):
    (tmp_path / "capture.json").write_text(*blocks("active_stereo.md", "json"), encoding="utf-8")
    manifest = read_manifest(tmp_path / "capture.json")
    assert len(manifest.other_cameras) == 1 and sum(frame.stereo is not None for frame in manifest.frames) == 2
    named = re.findall(r"^\| `(\w+)` \|", PAGES["active_stereo.md"], re.MULTILINE)
    assert len(named) == 5 and {name.upper() for name in named} <= set(Status.__members__)


def test_the_python_of_time_of_flight_runs():
    examples = blocks("time_of_flight.md", "python")
    assert any("toothed_wheel" in code for code in examples)  # the measured speed of light
    for code in examples:
        exec(compile(code, "time_of_flight.md", "exec"), {})
