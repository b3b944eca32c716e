"""The commands of docs/structured_light.md have the options that they are shown with."""

import re
from pathlib import Path

import pytest

DOCS = (Path(__file__).resolve().parents[3] / "docs" / "structured_light.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("command", ["patterns", "depth", "separate", "calibrate procam", "calibrate response", "import opencv-gray"])
def test_the_commands_have_the_options(command, relit):
    shown = relit(*command.split(), "--help").out
    lines = [line for line in DOCS.splitlines() if line.strip().startswith(f"relit {command}")]
    used = {option for line in lines for option in re.findall(r"--[a-z-]+", line)}
    assert used
    for option in used:
        assert option in shown, option
