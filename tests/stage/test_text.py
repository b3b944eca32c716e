"""Texts of every input are checked where they are read: no control characters, no halves of characters."""

import importlib
import json
import pkgutil
import typing

import pytest
from pydantic import BaseModel, TypeAdapter, ValidationError

import service.requests
import stage
from service.requests.base.base import Options, Role
from service.requests.jobs import UserJob
from stage.capture.manifest import read_manifest
from stage.errors import ManifestError
from stage.importers import lp
from stage.importers.opencv_file import read_matrices
from stage.model import Line, Strict, name_fault
from tests.service.server.api.captures import manifest

BAD = {"NUL": "a\0b", "newline": "a\nb", "escape": "\x1b[2J", "delete": "a\x7f", "C1": "a\x9b", "half": "b\ud800",
       "byte": "b\udcff", "long": "x" * 1001}


@pytest.mark.parametrize("text", BAD.values(), ids=BAD)
def test_what_is_no_name(text):
    assert str(name_fault(text)).startswith("has ")
    with pytest.raises(ValidationError, match=r"leave it out|give 1000 or fewer"):
        TypeAdapter(Line).validate_python(text)


@pytest.mark.parametrize("text", ["", "owl", "x" * 1000, "Ünïcode 猫 🦉", "a b", "a\u200db", "\u2028"])
def test_other_characters_are(text):
    assert name_fault(text) is None and TypeAdapter(Line).validate_python(text) == text


@pytest.mark.parametrize("text", BAD.values(), ids=BAD)
@pytest.mark.parametrize(("change", "field"), [
    ({"name": "TEXT"}, "name"), ({"mask": "TEXT"}, "mask"), ({"frames": [{"image": "TEXT", "light": {"type": "off"}}]}, "frames[0].image"),
    ({"frames": [{"image": "a.exr", "light": {"type": "environment", "image": "TEXT"}}]}, "frames[0].light.image")])
def test_a_manifest_is_refused_by_file_and_field(tmp_path, text, change, field):
    path = tmp_path / "capture.json"
    path.write_text(json.dumps(manifest(["a.exr"]) | change).replace("TEXT", json.dumps(text)[1:-1]))
    with pytest.raises(ManifestError) as error:
        read_manifest(path)
    assert str(error.value).startswith(f"{path}: {field}: has ")


def test_half_a_character_as_bytes_is_refused(tmp_path):
    (tmp_path / "capture.json").write_bytes(json.dumps(manifest(["a.exr"])).encode().replace(b"small", b"\xed\xa0\x80"))
    with pytest.raises(ManifestError, match=r"capture\.json: name: has half a character"):
        read_manifest(tmp_path / "capture.json")


@pytest.mark.parametrize("text", [text for name, text in BAD.items() if name not in ("newline", "half", "byte")])
def test_a_line_of_an_lp_file_is_refused_by_number(tmp_path, text):
    (tmp_path / "a.lp").write_text(f"1\n{text}.png 0 0 1\n")
    with pytest.raises(ManifestError, match=r"a\.lp: line 2: "):
        lp.import_folder(tmp_path, tmp_path / "out")


@pytest.mark.parametrize("field", ["tof_calibration", "capture", "name"])
@pytest.mark.parametrize("text", [text for name, text in BAD.items() if name in ("NUL", "newline", "escape")])
def test_a_request_is_refused(field, text):
    request = {"kind": "depth", "capture": "cap_0123456789abcdefghjk"}
    TypeAdapter(UserJob).validate_python(request)
    with pytest.raises(ValidationError):
        TypeAdapter(UserJob).validate_python(request | {field: text})


def models() -> list[type[BaseModel]]:
    for package in (stage, service.requests):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)
    found: list[type[BaseModel]] = [Strict, Options]
    for model in found:
        found += [each for each in model.__subclasses__() if not each.__module__.startswith("tests.")]  # as other tests make them
    return found


def bare_text(annotation: object, metadata: tuple[object, ...] = ()) -> bool:
    """Whether a type has a text in it that nothing checks."""
    if annotation is str:
        return not any(getattr(each, "pattern", None) or each in Line.__metadata__ or "pattern" in repr(each) for each in metadata)
    if hasattr(annotation, "__metadata__"):
        return bare_text(annotation.__origin__, annotation.__metadata__)  # type: ignore[attr-defined]
    return any(bare_text(part) for part in typing.get_args(annotation) if typing.get_origin(annotation) is not typing.Literal)


def test_every_text_of_a_manifest_or_a_request_is_checked():
    """Paths of the command line are left: the system allows any bytes in them."""
    assert bare_text(str) and bare_text(str | None) and bare_text(tuple[str, ...]) and not bare_text(Line) and not bare_text(Line | None)
    known = models()
    assert len(known) > 60
    unchecked = {f"{model.__name__}.{name}" for model in known for name, field in model.model_fields.items()
                 if Role.OUTPUT not in field.metadata and bare_text(field.annotation, tuple(field.metadata))}
    commands = {"HttpRequest.url", "HttpRequest.body", "SerialController.on", "SerialController.off"}  # with line ends, of a rig's owner
    assert unchecked == commands


@pytest.mark.parametrize("content", [
    '{"schema": "LONG"}', '{"schema": ["LONG"]}', '{"schema": "relit.capture/1", "LONG": 1}', '{"LONG": 1, "LONG": 2}',
    '{"schema": "relit.capture/1", "name": "a", "frames": [{"image": "a", "light": {"type": "LONG"}}]}'])
def test_a_sentence_does_not_repeat_a_long_value(tmp_path, content):
    (tmp_path / "capture.json").write_text(content.replace("LONG", "x" * 100_000))
    with pytest.raises(ManifestError) as error:
        read_manifest(tmp_path / "capture.json")
    assert max(len(fault.removeprefix(str(tmp_path))) for fault in str(error.value).split("; ")) < 400


def test_a_number_that_no_float_holds_is_no_matrix(tmp_path):
    (tmp_path / "camera.json").write_text(f'{{"a": {10**400}, "b": [1, 2]}}')
    assert set(read_matrices(tmp_path / "camera.json")) == {"b"}
