"""The template of a job of one step, and the files that it is written to.

Source: Open Job Description, template schemas 2023-09, with the extension TASK_CHUNKING (RFC 0001).
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from service.farm.parameters import Parameters
from service.requests.base import Request
from stage.files import write_text

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
    """Whether they lie in a folder as Deadline Cloud takes it."""


def job(command: str, subject: Path, words: list[str], request: Request, given: Parameters, *, gpu: bool,
        space: Mapping[str, Any] | None = None, extensions: tuple[str, ...] = ()) -> Job:
    """Return a job whose tasks call this program.

    Args:
        command: that the tasks call; names the step too.
        subject: the folder or file that the job is named after.
        words: of the call, after the command.
        request: says the device and the folder for caches.
        given: parameters so far.
        gpu: whether tasks need a worker with a GPU.
        space: of the tasks; None: there is one.
        extensions: of the specification that the job needs.
    """
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

    Args:
        made: the job.
        where: NAME.yaml, and NAME.values.yaml beside it; any other name is a folder, with template.yaml and parameter_values.yaml.

    Raises:
        StorageError: it cannot be written.
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
    """Return the name of a job; what a template would fill in is left out of it."""
    subject = subject.parent if subject.is_file() else subject
    shown = "".join(character for character in subject.absolute().name if character.isprintable() and character not in "{}")
    return f"relit {command} {shown}"[:LONGEST_NAME].rstrip()


def _yaml(data: Mapping[str, Any]) -> str:
    return yaml.safe_dump(dict(data), sort_keys=False, allow_unicode=True, width=140)
