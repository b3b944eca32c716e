"""The jobs that a farm can do: frames of `relit relight` in chunks, and pictures of `relit shade`; and the files of their templates.

Source: Open Job Description, template schemas 2023-09, with the extension TASK_CHUNKING (RFC 0001).
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from service.errors import RequestError
from service.requests.base.base import Request, Role
from service.requests.base.options import Option, help_text, typed, values_of
from service.requests.light.frame_range import numbered
from service.requests.relight import RelightRequest
from service.requests.shade import ShadeRequest
from stage.files import write_text

LONGEST = 1024
"""The specification's limit on the characters of a value."""


class Parameters:
    """Parameters in the order of the template, which the person who submits it may change. Each method adds one and returns the text that
    stands for its value there.

    Texts that a person chose are always parameters: {{…}} is filled in in a template, and in a parameter's value it is not. No shell reads
    either.
    """

    def __init__(self) -> None:
        self.definitions: list[Mapping[str, Any]] = []
        self.values: dict[str, str] = {}
        """The values of the parameters that have no default."""

    def text(self, name: str, value: str, about: str) -> str:
        """Add a text with a default."""
        return self._add(name, "STRING", about, default=_checked(value))

    def count(self, name: str, value: int, about: str) -> str:
        """Add a number from 1 on with a default."""
        return self._add(name, "INT", about, default=value, minValue=1)

    def file(self, name: str, value: Path, about: str) -> str:
        """Add a file that is read."""
        return self._path(name, value, "FILE", "IN", about)

    def folder(self, name: str, value: Path, flow: str, about: str) -> str:
        """Add a folder that is read (IN), written (OUT) or neither (NONE)."""
        return self._path(name, value, "DIRECTORY", flow, about)

    def words(self, request: Request) -> list[str]:
        """Return the words that type the input and the choices of a request, where they are not at their default."""
        arguments, rest = [], []
        for option, value in values_of(request):
            if value == option.field.default or option.role not in (Role.INPUT, Role.CHOICE):
                continue
            if option.spelling.argument:
                arguments.append(self._word(option, value, request))
            elif option.kind is bool:
                rest.append(option.flag if value else option.off)
            else:
                for each in value if option.is_repeated else (value,):
                    rest += [option.flag, self._word(option, each, request)]
        return [*arguments, *rest]

    def _word(self, option: Option, value: Any, request: Request) -> str:
        name = option.name.title().replace("_", "")
        about = help_text(option, type(request))
        if option.kind is str:
            return self.text(name, value, about)
        if option.role is not Role.INPUT:
            return typed(value)
        if "#" in value.name and not value.is_file():
            folder = self.folder(f"{name}Folder", value.parent, "IN", f"Folder of the files of {name}Name.")
            return f"{folder}/{self.text(f'{name}Name', value.name, about)}"
        return self.folder(name, value, "IN", about) if value.is_dir() else self.file(name, value, about)

    def _path(self, name: str, value: Path, kind: str, flow: str, about: str) -> str:
        self.values[name] = _checked(str(value.absolute()))
        # a path has no default: the specification wants those within the template's folder
        return self._add(name, "PATH", about, objectType=kind, dataFlow=flow)

    def _add(self, name: str, kind: str, about: str, **others: Any) -> str:
        self.definitions.append({"name": name, "type": kind, **others, "description": about})
        return f"{{{{Param.{name}}}}}"


def _checked(text: str) -> str:
    if len(text) > LONGEST:
        raise RequestError(f"{text[:40]}…: has {len(text)} characters, a value of a farm's job {LONGEST} at the most")
    if any(ord(character) < 32 or ord(character) == 127 for character in text):
        raise RequestError(f"{text!r}: holds a control character, which no value of a farm's job may")
    return text


MOST_TURNS = 1024
"""The specification's limit on the values of a task's parameter."""
NOTICE_S = 60
"""Seconds between the signal that asks a task to end and the signal that kills it, in which frames that are being written are finished."""
LONGEST_NAME = 128
TEMPLATE_SUFFIXES = (".yaml", ".yml")


class Job(NamedTuple):
    """A template, with values for its parameters that have no default."""

    template: Mapping[str, Any]
    values: Mapping[str, str]


class JobFiles(NamedTuple):
    """The files of a job."""

    template: Path
    values: Path
    is_bundle: bool
    """True if they lie in a folder as Deadline Cloud takes it."""


def relight_job(request: RelightRequest, *, chunk_frames: int, gpu: bool) -> Job:
    """Return a job whose tasks make parts of the frames, `chunk_frames` each unless who submits it says otherwise."""
    given = Parameters()
    words = given.words(request)
    folder, _, name = str(Path(request.out)).rpartition("/")
    words += ["--out", given.folder("OutputFolder", Path(folder), "OUT", "Where the frames go.") + "/"
              + given.text("FrameName", name, "Name of the frames, #### for the number."), "--only", "{{Task.Param.Chunk}}"]
    chunk = given.count("ChunkFrames", chunk_frames, "Frames of a task.")
    chunks = {"name": "Chunk", "type": "CHUNK[INT]", "range": "{{Param.Frames}}",
              "chunks": {"defaultTaskCount": chunk, "rangeConstraint": "CONTIGUOUS"}}
    return _job("relight", request.capture, words, request, given, gpu=gpu, space={"taskParameterDefinitions": [chunks]},
               extensions=("TASK_CHUNKING",))


def shade_job(request: ShadeRequest, *, turns: int | None, gpu: bool) -> Job:
    """Return a job of one picture, or of `turns` pictures over which the environment turns once around; the request's turn is the first."""
    given = Parameters()
    words = given.words(request if turns is None else request.model_copy(update={"turn_degrees": 0.0}))
    folder = given.folder("OutputFolder", request.out.parent, "OUT", "Where the picture goes.")
    if turns is None:
        words += ["--out", f"{folder}/" + given.text("PictureName", request.out.name, "Name of the picture.")]
        return _job("shade", request.maps, words, request, given, gpu=gpu)
    words += ["--out", f"{folder}/{{{{Task.Param.Picture}}}}", "--turn-degrees", "{{Task.Param.TurnDegrees}}"]
    return _job("shade", request.maps, words, request, given, gpu=gpu, space=_turned(request, turns))


def _turned(request: ShadeRequest, turns: int) -> dict[str, Any]:
    name = request.out.name
    if request.environment is None:
        raise RequestError(f"--turns {turns}: turns the environment: give --environment MAP")
    if turns > MOST_TURNS:
        raise RequestError(f"--turns {turns}: a job has {MOST_TURNS} pictures at the most")
    if len(re.findall("#+", name)) != 1 or "{{" in name:
        raise RequestError(f"--out {request.out}: with --turns the file name needs one run of # for the number, such as turn.####.exr, "
                           "and no {{")
    return {"taskParameterDefinitions": [
        {"name": "Picture", "type": "STRING", "range": [numbered(name, number) for number in range(1, turns + 1)]},
        {"name": "TurnDegrees", "type": "FLOAT", "range": [request.turn_degrees + 360 * turn / turns for turn in range(turns)]},
    ], "combination": "(Picture, TurnDegrees)"}


def _job(command: str, subject: Path, words: list[str], request: Request, given: Parameters, *, gpu: bool,
        space: Mapping[str, Any] | None = None, extensions: tuple[str, ...] = ()) -> Job:
    """Return a job named after `subject`, whose tasks call a command of this program with `words` and the request's device and cache."""
    program = given.text("Relit", "relit", "The program on the workers: a name on their PATH, or a path.")
    if request.cache is not None:
        words = [*words, "--cache", given.folder("Cache", request.cache, "NONE", "For image stacks, on each worker.")]
    device = request.device or ("cuda:0" if gpu else None)
    words = [command, *words, *(["--device", device] if device else []), "--progress", "openjd"]
    run = {"command": program, "args": words, "cancelation": {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": NOTICE_S}}
    step: dict[str, Any] = {"name": command}
    if space is not None:
        step["parameterSpace"] = space
    step["script"] = {"actions": {"onRun": run}}
    if gpu:
        step["hostRequirements"] = {"amounts": [{"name": "amount.worker.gpu", "min": 1}]}
    template: dict[str, Any] = {"specificationVersion": "jobtemplate-2023-09"}
    if extensions:
        template["extensions"] = list(extensions)
    return Job(template | {"name": _title(command, subject), "parameterDefinitions": given.definitions, "steps": [step]}, given.values)


def write_job(made: Job, where: Path) -> JobFiles:
    """Write the template of a job and its values.

    `where` is NAME.yaml, with NAME.values.yaml beside it, or a folder for template.yaml and parameter_values.yaml.
    """
    if where.suffix.lower() in TEMPLATE_SUFFIXES:
        files = JobFiles(where, where.with_suffix(f".values{where.suffix}"), False)
        values: Mapping[str, Any] = made.values
    else:
        files = JobFiles(where / "template.yaml", where / "parameter_values.yaml", True)
        values = {"parameterValues": [{"name": name, "value": value} for name, value in made.values.items()]}
    write_text(files.values, _yaml(values))
    write_text(files.template, _yaml(made.template))
    return files


def _title(command: str, subject: Path) -> str:
    subject = subject.parent if subject.is_file() else subject
    shown = "".join(character for character in subject.absolute().name if character.isprintable() and character not in "{}")
    return f"relit {command} {shown}"[:LONGEST_NAME].rstrip()


def _yaml(data: Mapping[str, Any]) -> str:
    return yaml.safe_dump(dict(data), sort_keys=False, allow_unicode=True, width=140)
