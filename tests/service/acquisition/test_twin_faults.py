"""The faults of the twin of a stage with the owl, named by the captures that see them; and the commands of docs/set.md."""

import json
import os
import shlex
import shutil
import subprocess
import sys

import pytest

from tests.service.acquisition.scenes import ROOT
from tests.service.acquisition.twin_in_process import TwinInProcess, named, wanted

CROP = "130,120,48,48"
"""The part of the owl that is solved."""


@pytest.fixture(scope="module")
def twin(tmp_path_factory):
    return TwinInProcess(tmp_path_factory.mktemp("twin"))


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_all_faults_of_a_capture_are_named_and_a_capture_without_any_retakes_nothing(twin, seed):
    """benchmarks/on_set.py takes 20 seeds."""
    sound = twin.capture(f"sound_{seed}", seed, {})
    assert sound.retaken == sound.faults == () and sound.there == 97
    faults = twin.faults(seed)
    mended = twin.capture(f"mended_{seed}", seed, faults)
    assert named(mended.retaken) == wanted(faults) and mended.faults == ()


@pytest.mark.long
def test_without_retakes_each_fault_is_named_and_stays(twin):
    """The picture that comes late is waited for, so that it is not taken for that of the next lamp."""
    faults = twin.faults(5)
    result = twin.capture("once", 5, faults, retakes=0)
    assert named((*result.retaken, *result.faults)) == wanted(faults) and result.there == 97 - 2


@pytest.mark.long
@pytest.mark.parametrize(("document", "pictures"), [("docs/set.md", 97), ("README.md", 96)])
def test_the_commands_of_the_documents_take_and_solve_the_owl_without_a_picture_taken_again(tmp_path, document, pictures):
    """As they have them, but for the crop of what is solved, for which --then stands alone; the twin's page has its port, and its lamps
    those of sACN."""
    if shutil.which("curl") is None:
        pytest.skip("no curl")
    page = (ROOT / document).read_text(encoding="utf-8")
    block = next(block for block in page.split("```")[1::2] if "samples/owl --pictures watched" in block)
    program = f"{sys.executable} -m service.cli.main "
    lines = [line.split("#")[0].strip().replace("relit ", program, 1) for line in block.strip().splitlines()]
    (tmp_path / "samples").symlink_to(ROOT / "samples")
    place = {"cwd": tmp_path, "env": {**os.environ, "PYTHONPATH": str(ROOT)}, "text": True}
    rig, twin, capture, *then = map(shlex.split, lines)
    if "--then" in capture:
        steps = capture[capture.index("--then") + 1]
        del capture[capture.index("--then"):]
        commands = {"solve": "solve capture --out maps", "export": "export maps --out asset.usdz"}
        then = [shlex.split(program + commands[step]) for step in steps.split(",")]
    subprocess.run(rig, check=True, **place)
    stage = subprocess.Popen(twin, stdout=subprocess.PIPE, **place)
    try:
        assert stage.stdout.readline().startswith("twin ")
        subprocess.run(capture, check=True, **place)
    finally:
        stage.kill()
        stage.wait()
    report = json.loads((tmp_path / "capture" / "report.json").read_text())
    assert (report["pictures"], report["retaken"], report["faults"]) == (pictures, [], [])
    subprocess.run([*then[0], "--crop", CROP], check=True, **place)
    for command in then[1:]:
        subprocess.run(command, check=True, **place)
    assert (tmp_path / "maps" / "maps.exr").stat().st_size > 0
    assert (tmp_path / "asset.usdz").exists() == (document == "README.md")
