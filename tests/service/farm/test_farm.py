"""relit farm template: what is written, and what the reference runner of Open Job Description makes of it."""

import importlib.util
import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from service.farm.jobs import Job, write_job
from service.requests.base.base import Role
from service.requests.base.options import options_of
from service.requests.relight import RelightRequest
from service.requests.shade import ShadeRequest
from stage.formats import exr
from tests.marks import first_short
from tests.scenes.captures import files_in, make_scene, write_capture, write_exr
from tests.scenes.glossy import dome, write_dome, write_maps

ROOT = Path(__file__).parents[3]
BIN = Path(sys.executable).parent
ODD = "it's $HOME \"quoted\" `ls` {{Param.Frames}} ü \\ & ; \U0001f989"
"""A folder's name in which a shell, YAML or a template could find something."""

needs_openjd = pytest.mark.skipif(importlib.util.find_spec("openjd.cli") is None if importlib.util.find_spec("openjd") else True,
                                  reason="openjd-cli is not installed")


def openjd(*words, cwd):
    """Run `openjd`, with this environment's relit on the PATH."""
    environment = {**os.environ, "PATH": f"{BIN}{os.pathsep}{os.environ['PATH']}"}
    return subprocess.run([sys.executable, "-m", "openjd", *map(str, words)], capture_output=True, text=True, cwd=cwd, env=environment,
                          timeout=240)


def read(path):
    import yaml  # of openjd-model

    return yaml.safe_load(path.read_text(encoding="utf-8"))


def contents(folder):
    return {name: (folder / name).read_bytes() for name in files_in(folder)}


@pytest.fixture
def shots(tmp_path):
    """A folder of an odd name with a capture and a map, which is also where commands run."""
    folder = tmp_path / ODD
    write_capture(folder / "my cap", make_scene(size=16, lights=6))
    write_exr(folder / "a sky.exr", np.random.default_rng(1).random((16, 32, 3)))
    return folder


@pytest.mark.long
@needs_openjd
def test_frames_of_a_farm_are_those_of_one_run(relit, shots, monkeypatch):
    monkeypatch.chdir(shots)
    words = ("my cap", "--environment", "a sky.exr", "--frames", "3-8", "--spin-degrees", "-90", "--exposure", "0.5", "--aov", "mask",
             "--color-space", "lin_ap1_scene", "--compression", "piz", "--device", "cpu")
    assert relit("relight", *words, "--out", "whole/a $b.####.exr").code == 0
    out = relit("farm", "template", "relight", *words, "--out", "farm/a $b.####.exr", "--cache", "some cache",
                "--chunk-frames", "4", "--job", "job.yaml").well()
    assert out == "template job.yaml\nvalues   job.values.yaml\nrun      openjd run job.yaml -p file://job.values.yaml\n"
    checked = openjd("check", "job.yaml", cwd=shots)
    assert checked.returncode == 0 and "passes validation checks" in checked.stdout
    ran = openjd("run", "job.yaml", "-p", "file://job.values.yaml", cwd=shots)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "Chunks run: 2" in ran.stdout and "openjd_status: frames" in ran.stdout and "openjd_progress: 100" in ran.stdout
    assert len(contents(shots / "whole")) == 6 and contents(shots / "farm") == contents(shots / "whole")
    assert (shots / "some cache").is_dir()


@pytest.mark.long
@needs_openjd
def test_a_task_that_fails_fails_the_job(relit, shots, monkeypatch):
    monkeypatch.chdir(shots)
    relit("farm", "template", "relight", "my cap", "--environment", "a sky.exr", "--out", "f/a.#.exr", "--job", "job.yaml")
    (shots / "my cap" / "003.exr").unlink()
    ran = openjd("run", "job.yaml", "-p", "file://job.values.yaml", cwd=shots)
    assert ran.returncode != 0 and "relit: " in ran.stdout and "003.exr" in ran.stdout


@pytest.mark.long
@needs_openjd
def test_a_turn_of_pictures(relit, tmp_path, monkeypatch):
    folder = tmp_path / ODD
    surface = dome(size=12)
    write_maps(folder / "maps", surface)
    write_exr(folder / "sky.exr", np.random.default_rng(1).random((16, 32, 3)))
    monkeypatch.chdir(folder)
    words = ("maps", "--environment", "sky.exr", "--light", "-0.001,0.002,0.03,1e-05,2e-5,3e-5", "--sphere", "0,0,0.1,0.01,1,2,3",
             "--rectangle", "0,0,.1,.01,0,0,0,.02,0,5,5,5", "--light", "0,0,0.1,1,1,1,0,0,-1,2", "--device", "cpu")
    out = relit("farm", "template", "shade", *words, "--turns", "2", "--turn-degrees", "10", "--out", "farm/lit.##.exr",
                "--job", "b").well()
    assert out == "template b/template.yaml\nvalues   b/parameter_values.yaml\nsubmit   deadline bundle submit b\n"
    values = {each["name"]: each["value"] for each in read(folder / "b" / "parameter_values.yaml")["parameterValues"]}
    ran = openjd("run", "b/template.yaml", "-p", json.dumps(values), cwd=folder)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    for number, turn in enumerate((10.0, 190.0), start=1):
        assert relit("shade", *words, "--turn-degrees", str(turn), "--out", f"here/lit.0{number}.exr").code == 0
    assert len(contents(folder / "here")) == 2 and contents(folder / "farm") == contents(folder / "here")


@needs_openjd
@first_short("command", ["relight", "relight guided", "shade", "shade captured"])
def test_every_template_is_valid(relit, tmp_path, command):
    """With every option there is; and every path is said to be read or written, so that a farm can bring it and take it away."""
    write_dome(tmp_path / "cap", dome(size=12), lights=12)
    write_maps(tmp_path / "maps", dome(size=12))
    for number in (1, 2):
        write_exr(tmp_path / f"sky.{number}.exr", np.ones((8, 16, 3)))
    (tmp_path / "keys.json").write_text(json.dumps({"schema": "relit.keys/1", "exposure": [{"frame": 1, "stops": 1}]}))
    words = {
        "relight": ["relight", tmp_path / "cap", "--environment", tmp_path / "sky.#.exr", "--frames", "1-2",
                    "--keys", tmp_path / "keys.json", "--align-to", "000.exr", "--weights", "smooth", "--gpu"],
        "relight guided": ["relight", tmp_path / "cap", "--environment", tmp_path / "sky.1.exr", "--maps", tmp_path / "maps",
                           "--aov", "diffuse,normal", "--align", "--cache", tmp_path / "cache"],
        "shade": ["shade", tmp_path / "maps", "--sphere", "0,0,1,.1,1,1,1", "--exposure", "-1", "--gpu"],
        "shade captured": ["shade", tmp_path / "maps" / "maps.exr", "--environment", tmp_path / "sky.1.exr", "--turn-degrees", "5",
                           "--capture", tmp_path / "cap", "--color-space", "lin_ap1_scene", "--compression", "dwaa"],
    }[command]
    out = tmp_path / "out" / "f.####.exr"
    relit("farm", "template", *words, "--out", out, "--job", tmp_path / "job.yml").well()
    checked = openjd("check", tmp_path / "job.yml", cwd=tmp_path)
    assert checked.returncode == 0, checked.stdout + checked.stderr
    template, values = read(tmp_path / "job.yml"), read(tmp_path / "job.values.yml")
    flows = {each["name"]: each["dataFlow"] for each in template["parameterDefinitions"] if each["type"] == "PATH"}
    assert flows.keys() == values.keys() and all(Path(value).is_absolute() for value in values.values())
    assert {name for name, flow in flows.items() if flow != "IN"} == {"OutputFolder", *(["Cache"] if "--cache" in words else [])}
    needs = template["steps"][0].get("hostRequirements")
    assert needs == ({"amounts": [{"name": "amount.worker.gpu", "min": 1}]} if "--gpu" in words else None)
    run = template["steps"][0]["script"]["actions"]["onRun"]
    assert ("cuda:0" in run["args"]) == ("--gpu" in words)
    named = {word.partition("Param.")[2].partition("}}")[0] for word in (run["command"], *run["args"]) if "{{Param." in word}
    named |= {part.partition("}}")[0] for word in run["args"] for part in word.split("{{Param.")[2:]}
    assert named | {"ChunkFrames"} >= {each["name"] for each in template["parameterDefinitions"]}  # none is asked for and not used


@pytest.mark.parametrize(("words", "sentence"), [
    (["relight", "cap", "--out", "a.#.exr"], "nothing lights the frames"),
    (["relight", "cap", "--environment", "sky.exr", "--out", "a.exr"], "needs one run of #"),
    (["relight", "cap", "--environment", "sky.exr", "--out", "a.#.exr", "--frames", "9-1"], "runs backwards"),
    (["relight", "cap", "--environment", "none.exr", "--out", "a.#.exr"], "none.exr"),
    (["relight", "cap", "--environment", "sky.exr", "--out", "a.#.exr", "--chunk-frames", "0"], "--chunk-frames"),
    (["relight", "cap", "--environment", "sky.exr", "--out", "a.#.exr", "--only", "1"], "no such option: --only"),
    (["relight", "cap", "--environment", "sky.exr", "--out", "shot#1/a.#.exr"], "needs one run of #"),
    (["relight", "cap", "--environment", "sky.exr", "--out", f"{'x' * 1100}.#.exr"], "1024 at the most"),
    (["relight", "cap", "--environment", "sky.exr", "--out", "a\nb.#.exr"], "control character"),
    (["shade", "maps", "--out", "a.exr"], "there is no light"),
    (["shade", "none", "--environment", "sky.exr", "--out", "a.exr"], "is not there"),
    (["shade", "maps", "--environment", "sky.exr", "--out", "a.exr", "--turns", "3"], "with --turns the file name needs one run of #"),
    (["shade", "maps", "--environment", "sky.exr", "--out", "{{a}}.#.exr", "--turns", "3"], "and no {{"),
    (["shade", "maps", "--environment", "sky.exr", "--out", "a.#.exr", "--turns", "1025"], "1024 pictures at the most"),
    (["shade", "maps", "--light", "0,0,1,1,1,1", "--out", "a.#.exr", "--turns", "3"], "give --environment"),
])
def test_a_job_that_cannot_be(relit, tmp_path, monkeypatch, words, sentence):
    write_capture(tmp_path / "cap", make_scene(size=8, lights=4))
    write_maps(tmp_path / "maps", dome(size=8))
    write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3)))
    monkeypatch.chdir(tmp_path)
    relit("farm", "template", *words, "--job", "job.yaml").refused(sentence)
    assert not (tmp_path / "job.yaml").exists()


@needs_openjd
def test_yaml_says_what_was_meant(tmp_path):
    texts = ["", " ", "no", "1", "null", "a: b", "- a", "#a", "\"'\\", "{{x}}", "é\U0001f989", "\x7f\x85\u2028\ufeff", "x" * 300, "%a", "@",
             "`"]
    data = {"texts": texts, "numbers": [1, -2, 0.5, 1e-7, 1e22, math.pi],
            "inner": {"list": [{"a": "b", "c": [{"d": "e"}]}, "f"], "empty": [], "flag": True}}
    write_job(Job(data, {"A": ODD}), tmp_path / "a.yaml")
    assert read(tmp_path / "a.yaml") == data and read(tmp_path / "a.values.yaml") == {"A": ODD}


def test_progress_lines_of_a_task(relit, tmp_path):
    write_capture(tmp_path / "cap", make_scene(size=8, lights=4))
    write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3)))
    sky = ("--environment", tmp_path / "sky.exr", "--progress", "openjd")
    outcome = relit("relight", tmp_path / "cap", *sky, "--out", tmp_path / "f" / "a.#.exr", "--frames", "1-4")
    lines = outcome.out.splitlines()
    assert [line for line in lines if "status" in line] == ["openjd_status: open", "openjd_status: ingest", "openjd_status: frames"]
    percents = [int(line.partition(": ")[2]) for line in lines if line.startswith("openjd_progress")]
    assert percents == sorted(set(percents)) and percents[-1] == 100 and 25 in percents
    assert exr.read(tmp_path / "f" / "a.4.exr")
    failed = relit("relight", tmp_path / "none", *sky, "--out", tmp_path / "a.#.exr")
    assert failed.code == 2 and "openjd_progress: 100" not in failed.out


def test_progress_lines_of_a_solve_count_each_stage(relit, tmp_path):
    write_capture(tmp_path / "cap", make_scene(size=8, lights=4))
    lines = relit("solve", tmp_path / "cap", "--progress", "openjd", "--out", tmp_path / "maps").out.splitlines()
    stages = [line.removeprefix("openjd_status: ") for line in lines if "status" in line]
    assert stages[:3] == ["open", "files", "ingest"] and stages[-1] == "write"
    ingest = lines[lines.index("openjd_status: ingest") + 1 : lines.index(f"openjd_status: {stages[3]}")]
    assert "openjd_progress: 25" in ingest and "openjd_progress: 100" in lines


def test_the_docs_name_every_option_and_parameter(relit, tmp_path):
    text = (ROOT / "docs" / "farm.md").read_text(encoding="utf-8")
    for command, model in (("relight", RelightRequest), ("shade", ShadeRequest)):
        outcome = relit("farm", "template", command, "--help")
        own = set(re.findall(r"--[a-z-]+", outcome.out)) - set(re.findall(r"--[a-z-]+", relit(command, "--help").out))
        assert own and {option for option in own if f"`{option}" not in text} == set()
        assert all(f"`{option.flag}`" in text for option in options_of(model) if option.role in (Role.PART, Role.RUN))
    asked = set(re.findall(r'given\.(?:text|count|file|folder)\("(\w+)"',
                           (ROOT / "service" / "farm" / "jobs.py").read_text(encoding="utf-8")))
    asked |= {option.name.title().replace("_", "") for model in (RelightRequest, ShadeRequest) for option in options_of(model)
              if option.role is Role.INPUT or (option.role is Role.CHOICE and option.kind is str)}
    assert len(asked) > 10 and {name for name in asked if f"`{name}`" not in text} == set()
    for script in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        compile(script, "docs/farm.md", "exec")
