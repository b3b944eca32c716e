"""The faults of the twin of a stage with the owl, named by the captures that see them; and the commands of docs/set.md."""

import json
import os
import shlex
import shutil
import subprocess
import sys

import pytest

from tests.service.acquisition.twin_in_process import TwinInProcess, named, wanted
from tests.service.twin_program import ROOT

CROP = "130,120,48,48"
"""The part of the owl that is solved."""


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    return TwinInProcess(tmp_path_factory.mktemp("twin"))


@pytest.mark.long
def test_all_faults_of_a_capture_are_named_and_taken_again(twin):
    """benchmarks/on_set.py takes 20 seeds; that nothing is taken again without a fault is tested with the commands of the README."""
    faults = twin.faults(1)
    mended = twin.capture("mended", 1, faults)
    assert named(mended.retaken) == wanted(faults) and mended.faults == ()


@pytest.mark.long
def test_without_retakes_each_fault_is_named_and_stays(twin):
    """The picture that comes late is waited for, so that it is not taken for that of the next lamp."""
    faults = twin.faults(5)
    result = twin.capture("once", 5, faults, retakes=0)
    assert named((*result.retaken, *result.faults)) == wanted(faults) and result.there == 97 - 2


def commands_of(document: str) -> list[list[str]]:
    """The words of the commands with which a document shows the stage that is not there."""
    page = (ROOT / document).read_text(encoding="utf-8")
    block = next(block for block in page.split("```")[1::2] if "samples/owl --pictures watched" in block)
    return [shlex.split(line.split("#")[0]) for line in block.strip().splitlines()]


@pytest.mark.long
def test_the_commands_of_the_readme_take_and_solve_the_owl_without_a_picture_taken_again(tmp_path):
    """The commands run as they stand, but for the crop of what is solved: the steps of --then run by themselves, with it. The twin uses its
    own port, and the lamps those of sACN."""
    if shutil.which("curl") is None:
        pytest.skip("no curl")
    program = [sys.executable, "-m", "service.cli.main"]
    rig, twin, capture = ([*program, *words[1:]] for words in commands_of("README.md"))
    (tmp_path / "samples").symlink_to(ROOT / "samples")
    place = {"cwd": tmp_path, "env": {**os.environ, "PYTHONPATH": str(ROOT)}, "text": True}
    steps = capture[capture.index("--then") + 1]
    del capture[capture.index("--then"):]
    commands = {"solve": "solve capture --out maps", "export": "export maps --out asset.usdz"}
    then = [[*program, *shlex.split(commands[step])] for step in steps.split(",")]
    subprocess.run(rig, check=True, **place)
    stage = subprocess.Popen(twin, stdout=subprocess.PIPE, **place)
    try:
        assert stage.stdout.readline().startswith("twin ")
        subprocess.run(capture, check=True, **place)
    finally:
        stage.kill()
        stage.wait()
    report = json.loads((tmp_path / "capture" / "report.json").read_text())
    assert (report["pictures"], report["retaken"], report["faults"]) == (96, [], [])
    subprocess.run([*then[0], "--crop", CROP], check=True, **place)
    for command in then[1:]:
        subprocess.run(command, check=True, **place)
    assert (tmp_path / "maps" / "maps.exr").stat().st_size > 0
    assert (tmp_path / "asset.usdz").exists()


def test_the_commands_of_the_page_of_the_set_are_those_of_the_readme_with_a_dark_picture():
    """So that one document's are run."""
    readme, page = commands_of("README.md"), commands_of("docs/set.md")
    options = readme[2][: readme[2].index("--then")]
    assert page[:2] == readme[:2] and sorted(page[2]) == sorted([*options[:2], "dark,olat", *options[3:]])
    assert page[3:] == [["relit", "solve", "capture", "--out", "maps"]]
