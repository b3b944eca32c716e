"""The program itself: help, version, doctor, import and info, wrong options, and the way it ends."""

import multiprocessing
import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from typer import Context
from typer.main import get_command

import service
from service.captures import info
from service.cli.main import BLAS_THREADS, COMMANDS, main, program
from service.server.base.log import logger
from service.server.base.settings import Settings
from service.server.process import devices as process_devices
from stage.capture.capture import Capture
from stage.stack.ingest import Ingest
from tests.marks import first_short
from tests.scenes.captures import edit_manifest, make_scene, write_capture, write_exr, write_image

SHOWN = ["demo", "import", "info", "calibrate", "solve", "depth", "separate", "inspect-board", "join", "register", "fuse", "relight",
         "basis", "view", "export", "inspect", "doctor", "kernels", "bench", "serve", "worker", "keys"]
ROOT = Path(service.__file__).parents[1]


def test_help_names_every_command_and_the_version_is_printed(relit):
    out = relit("--help").well()
    assert all(f" {name} " in out for name in SHOWN)
    assert relit() == (2, "", out)  # nothing asked: the same help, and not a success
    assert relit("--version") == (0, f"relit {service.__version__}\n", "")


def test_the_help_that_is_shown_without_loading_commands_is_theirs(relit):
    command = get_command(program())
    assert relit("--help").out == command.get_help(Context(command, info_name="relit")) + "\n"
    loaded = subprocess.run([sys.executable, "-X", "importtime", "-m", "service.cli.main", "--help"], cwd=ROOT, check=True, text=True,
                            capture_output=True).stderr
    assert "typer" in loaded
    assert not any(heavy in loaded for heavy in ("pydantic", "numpy", "service.requests"))


@pytest.mark.parametrize("command", SHOWN)
def test_help_of_each_command(relit, command):
    out = relit(command, "--help").well()
    assert f"relit {command}" in out and "--help" in out


@pytest.mark.parametrize("command", [
    ["demo", "--out", "OUT"], ["import", "lp", "CAPTURE", "OUT"], ["info", "CAPTURE"], ["solve", "CAPTURE", "--out", "OUT"],
    ["relight", "CAPTURE", "--environment", "CAPTURE/000.exr", "--out", "OUT/f.####.exr"], ["export", "CAPTURE", "--out", "OUT/a.usdz"],
    ["basis", "CAPTURE", "--out", "OUT/b.exr"], ["view", "CAPTURE", "--out", "OUT"], ["separate", "CAPTURE", "--out", "OUT"],
    ["calibrate", "mirror-ball", "CAPTURE", "--ball", "8,8,4"], ["calibrate", "intensity", "CAPTURE"], ["doctor"], ["bench"],
], ids=lambda command: " ".join(command[:2]))
def test_every_command_takes_a_device_and_refuses_one_that_is_not_there(relit, tmp_path, command):
    capture = write_capture(tmp_path / "capture")
    words = [word.replace("CAPTURE", str(capture)).replace("OUT", str(tmp_path / "out")) for word in command]
    relit(*words, "--device", "cuda:99").refused("device cuda:99 is not on this machine: ", printed=command == ["doctor"])
    assert not (tmp_path / "out").exists() or not any((tmp_path / "out").iterdir())


def test_doctor_finds_this_installation_sound(relit):
    out = relit("doctor").well()
    assert out.splitlines()[-1] == "sound"
    assert "cpu" in out and "works" in out


def test_a_driver_that_is_too_old_for_the_gpu_is_said(relit, tmp_path, monkeypatch):
    monkeypatch.setattr(wp, "get_cuda_driver_version", lambda: (12, 9))
    monkeypatch.setattr(wp, "get_cuda_toolkit_version", lambda: (13, 4))
    sentence = "the NVIDIA driver of this machine supports CUDA 12.9, and Warp needs CUDA 13.0 or newer"
    outcome = relit("doctor")
    assert outcome.code == 1 and sentence in outcome.out
    capture = write_capture(tmp_path / "capture")
    assert sentence in relit("solve", capture, "--method", "lambert", "--out", tmp_path / "out").out
    assert sentence not in relit("solve", capture, "--method", "lambert", "--device", "cpu", "--out", tmp_path / "out").out
    said = []
    here = SimpleNamespace(apply=lambda ask, given: ask(*given))
    monkeypatch.setattr(multiprocessing, "get_context", lambda _: SimpleNamespace(Pool=lambda _: nullcontext(here)))
    monkeypatch.setattr(logger, "warning", said.append)
    process_devices.of_workers(Settings(data=tmp_path / "data"))
    process_devices.resolve(None)
    assert len(said) == 2 and all(sentence in each for each in said)


@pytest.mark.parametrize(("arguments", "words"), [
    (["paint"], "no such command 'paint'"),
    (["solve"], "missing argument 'CAPTURE'"),
    (["solve", "cap"], "missing option '--out': see relit solve --help"),
    (["solve", "cap", "--out", "o", "--method", "magic"],
     "invalid value for '--method': 'magic' is not one of"),
    (["solve", "cap", "--colour"], "no such option: --colour"),
    (["import", "zip", "a", "b"], "no such command 'zip': see relit import --help"),
    (["bench", "--repeats", "1"], "repeats: is 1: input should be greater than or equal to 3"),
])
def test_wrong_options_are_one_sentence(relit, arguments, words):
    relit(*arguments).refused(words)


def test_info_of_a_sound_capture(relit, tmp_path):
    scene = make_scene(size=8, lights=4)
    write_capture(tmp_path, scene, saturation=0.2)
    facts = {line.split()[0]: line[13:] for line in relit("info", tmp_path).well().splitlines()}
    assert facts["name"] == "cap" and facts["frames"] == "4 distant light" and facts["given"] == "mask, saturation"
    assert facts["camera"] == "orthographic, 8x8, no scale" and facts["mask"] == f"{scene.mask.sum()} of 64 pixels"
    assert facts["lights"].startswith("4 distant, up to 30 degrees") and facts["lights"].endswith("0 behind the object")
    assert float(facts["brightest"].split()[0]) == float(f"{scene.images.max():.4g}")
    assert facts["saturated"] == f"{int((scene.images.astype(np.float32) >= 0.2).any(axis=-1).sum())} readings at or above 0.2"
    write_capture(tmp_path / "patterns", scene, frames=[
        {"image": f"{i:03d}.exr", "pattern": {"code": "gray", "axis": "column", "bit": i, "bits": 4}} for i in range(4)])
    assert "4 gray pattern" in relit("info", tmp_path / "patterns").well()


def test_info_lists_every_fault_and_ends_with_the_first(relit, tmp_path):
    write_capture(tmp_path, make_scene(size=8, lights=2))
    write_exr(tmp_path / "000.exr", np.full((8, 8, 3), -1.0))
    write_image(tmp_path / "mask.png", np.zeros((8, 8), np.uint8))
    outcome = relit("info", tmp_path)
    assert outcome.code == 2
    wrong = [line[13:] for line in outcome.out.splitlines() if line.startswith("wrong ")]
    assert len(wrong) == 3
    assert "000.exr: 64 pixels are negative" in wrong[0] and "needs three or more" in wrong[1] and "mask is empty" in wrong[2]
    assert outcome.err == f"relit: {wrong[0]} (and 2 more, above)\n"


def test_import_diligent_and_look_at_it(relit, tmp_path):
    source = tmp_path / "ballPNG"
    for index in range(3):
        write_image(source / f"{index}.png", np.full((4, 4, 3), 9000, np.uint16))
    (source / "filenames.txt").write_text("0.png\n1.png\n2.png\n")
    (source / "light_directions.txt").write_text("0 0 1\n0.5 0 1\n0 0.5 1\n")
    (source / "light_intensities.txt").write_text("1 1 1\n" * 3)
    outcome = relit("import", "diligent", source, tmp_path / "ball")
    assert outcome == (0, f"capture  {tmp_path}/ball/capture.json\n", "")
    assert relit("info", tmp_path / "ball").code == 0
    assert Capture.open(tmp_path / "ball").name == "ballPNG"
    (source / "light_directions.txt").write_text("0 0 1\n0 0 0\n0 0.5 1\n")
    outcome = relit("import", "diligent", source, tmp_path / "other")
    assert outcome == (2, "", f"relit: {source / 'light_directions.txt'}: line 2: 0 0 0 is no direction and no position\n")
    assert not (tmp_path / "other").exists()


def test_an_interruption_ends_with_130_and_a_sentence_and_a_defect_of_ours_keeps_its_traceback(relit, tmp_path, monkeypatch):
    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(Ingest, "stack", interrupt)
    write_capture(tmp_path / "cap", make_scene(size=4, lights=4))
    outcome = relit("solve", tmp_path / "cap", "--out", tmp_path / "out")
    assert outcome.code == 130
    assert outcome.err.startswith("relit: interrupted") and outcome.err.count("\n") == 1
    monkeypatch.setattr(service.cli.main, "program", interrupt)  # while modules are loaded
    monkeypatch.setattr(sys, "argv", ["relit", "info", str(tmp_path)])
    with pytest.raises(SystemExit, match="130"):
        main()
    monkeypatch.undo()

    def fail(*arguments, **options):
        raise ZeroDivisionError

    monkeypatch.setattr(info.Capture, "open", fail)
    monkeypatch.setattr(sys, "argv", ["relit", "info", str(tmp_path)])
    with pytest.raises(ZeroDivisionError):
        main()


@pytest.mark.long
def test_as_a_program_of_its_own_whose_reader_may_go_away(tmp_path):
    def run(*arguments: object) -> subprocess.CompletedProcess:
        return subprocess.run([sys.executable, "-m", "service.cli.main", *map(str, arguments)], capture_output=True, text=True,
                              timeout=120, env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd=ROOT)

    write_capture(tmp_path / "cap", make_scene(size=8, lights=4))
    done = run("solve", tmp_path / "cap", "--method", "lambert", "--out", tmp_path / "out")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "out" / "maps.exr").exists()
    edit_manifest(tmp_path / "cap", colour="red")
    done = run("info", tmp_path / "cap")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"relit: {tmp_path}/cap/capture.json: colour: is not a known key\n"
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([sys.executable, "-m", "service.cli.main", "--help"], stdout=writer, stderr=subprocess.PIPE, text=True,
                          cwd=ROOT, timeout=60)
    os.close(writer)
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_in_the_module_that_is_loaded_for_it(name):
    assert name in get_command(program(name)).commands


@first_short(("given", "expected"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3"), ({"OMP_NUM_THREADS": "2"}, None)])
def test_linear_algebra_has_one_thread_unless_the_user_says_otherwise(relit, monkeypatch, given, expected):
    for name in BLAS_THREADS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(os, "environ", {**os.environ, **given})
    relit("--version")
    assert os.environ.get("OPENBLAS_NUM_THREADS") == expected


def test_a_folder_of_kernels_that_is_not_there_is_said(relit, tmp_path, monkeypatch):
    folder = tmp_path / "none"
    monkeypatch.setenv("RELIT_KERNELS", str(folder))
    monkeypatch.setattr("kernels.device.MADE_AHEAD", folder)
    outcome = relit("doctor", "--device", "cpu")
    assert outcome.code == 1 and f"{folder}, which RELIT_KERNELS names, is no folder" in outcome.out
