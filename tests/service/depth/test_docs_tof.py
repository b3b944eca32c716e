"""What docs/time_of_flight.md says is run: its Python, its JSON, and the options of its commands."""

import json
import re
from pathlib import Path

import pytest

from stage.tof.calibration import Sweep, TofCalibration
from stage.tof.scan import Scan

DOCS = (Path(__file__).resolve().parents[3] / "docs" / "time_of_flight.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(\w*)\n(.*?)```", DOCS, re.DOTALL)


@pytest.mark.parametrize("code", [code for kind, code in BLOCKS if kind == "python"])
def test_the_python_runs(code):
    exec(compile(code, "time_of_flight.md", "exec"), {})


def test_the_speed_of_light_is_among_it():
    assert any("toothed_wheel" in code for kind, code in BLOCKS if kind == "python")


def test_the_json_is_read():
    calibration, sweep, scan = (json.loads(code) for kind, code in BLOCKS if kind == "json")
    assert len(Sweep.model_validate(sweep).steps) == 2
    assert TofCalibration.model_validate(calibration).pulse_sigma_s == 1.2e-9
    assert Scan.model_validate(scan).name == "yard"


@pytest.mark.parametrize("command", ["depth", "scan"])
def test_the_commands_have_the_options(command, relit, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")  # so that no name of an option is cut
    shown = relit(command, "--help").out
    used = {option for line in DOCS.splitlines() if line.startswith(f"relit {command}") for option in re.findall(r"--[a-z-]+", line)}
    assert used
    for option in used:
        assert option in shown
