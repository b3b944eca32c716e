"""docs/python_client.md: its examples run, and what it names is there."""

import re
import shlex
import shutil
from pathlib import Path

import pytest

from service.client import Client
from tests.scenes.captures import write_capture
from tests.service.client.conftest import HOME, OWL, SKY

TEXT = (HOME / "docs" / "python_client.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


@pytest.mark.long
def test_the_program_runs(server, key, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    program, = blocks("python")
    monkeypatch.chdir(tmp_path)
    for said, meant in (("http://127.0.0.1:8470", server.url), ("key_…", key), ("samples/owl", str(OWL))):
        assert said in program
        program = program.replace(said, meant)
    names: dict[str, object] = {}
    exec(compile(program, "python_client.md", "exec"), names)
    assert names["frames"] == [Path("result") / f"frame.{number:04d}.exr" for number in (1, 2, 3)]
    assert sorted(path.name for path in (tmp_path / "result").iterdir()) == [path.name for path in names["frames"]]


@pytest.mark.long
def test_the_first_command_runs(relit, server, key, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    line = next(line for line in blocks("sh")[1].splitlines() if "submit pipeline" in line)
    small = write_capture(tmp_path / "ball")
    shutil.copy(SKY, small)
    words = shlex.split(line.replace("samples/owl", str(small)).replace("1-24", "1-2"))
    monkeypatch.setenv("RELIT_SERVER", server.url)
    monkeypatch.setenv("RELIT_KEY", key)
    monkeypatch.chdir(tmp_path)
    assert relit(*words[1:]).code == 0
    assert {"asset.usdz", "frame.0001.exr", "maps.exr"} <= {path.name for path in (tmp_path / "result").iterdir()}


def test_every_command_and_option_that_is_named_exists_and_every_method_is_named(relit):
    lines = [shlex.split(line, comments=True) for block in blocks("sh")[1:] for line in block.splitlines() if line.startswith("relit")]
    assert len(lines) > 6
    for _, group, command, *words in lines:
        out = relit(group, command, "--help").well()
        for word in words:
            assert not word.startswith("--") or word in out, (group, command, word)
    with Client() as client:
        for part in (client.captures, client.annotations, client.jobs):
            for name in dir(part):
                assert name.startswith("_") or f"`{name}`" in TEXT, name
