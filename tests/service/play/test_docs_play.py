"""docs/drive.md on playing and rehearsing: every option of both commands is told, and none that does not exist."""

import re
from pathlib import Path

from service.requests.base.options import options_of
from service.requests.play import PlayRequest, TwinRequest

PAGE = Path(__file__).parents[3] / "docs" / "drive.md"
TEXT = PAGE.read_text(encoding="utf-8").partition("## Play and rehearse")[2].partition("\n## ")[0]
ELSEWHERE = {"--cache"}
"""Options that all commands with images have."""
CAMERA = {"--pictures", "--picture-format", "--faults", "--noise", "--seed"}
"""Options of the twin's camera, which docs/set.md tells."""


def test_the_page_names_the_options_that_there_are():
    options = [option for model in (PlayRequest, TwinRequest) for option in options_of(model) if not option.spelling.argument]
    named = set(re.findall(r"--[a-z][a-z-]+", TEXT))
    known = {option.flag for option in options} | {option.off for option in options if option.kind is bool}
    assert named <= known
    wanted = {option.off if option.field.default is True else option.flag for option in options} - {"--device"} - ELSEWHERE
    assert wanted & set(re.findall(r"--[a-z][a-z-]+", (PAGE.parent / "set.md").read_text(encoding="utf-8"))) >= CAMERA
    assert wanted - CAMERA <= named
