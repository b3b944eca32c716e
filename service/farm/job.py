"""What the jobs of all commands have in common: how a task is called, what it needs, and how it ends.

Source: Open Job Description, template schemas 2023-09, with the extension TASK_CHUNKING (RFC 0001).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from service.farm.document import Plain
from service.farm.parameters import Job, Parameters
from service.requests.base import Request
from service.requests.picture import FrameCompression, Layer, PictureOptions

NOTICE_S = 60
"""Between the signal that asks a task to end and the one that kills it: the frames that are being written are finished."""
LONGEST_NAME = 128


class JobOptions(NamedTuple):
    """Of a job."""

    gpu: bool = False
    """A task needs a worker with a GPU."""


def job(name: str, step: str, words: list[str], request: Request, options: JobOptions, given: Parameters,
        space: Mapping[str, Plain] | None, *, extensions: Sequence[str] = ()) -> Job:
    """A job of one step.

    Args:
        name, step: of the job and its step.
        words: of the call, without the program.
        request: says the device and the folder for caches.
        options: of the job.
        given: parameters so far.
        space: of the tasks; None: there is one.
        extensions: of the specification that it needs.
    """
    program = given.text("Relit", "relit", "The program on the workers: a name on their PATH, or a path.")
    if request.cache is not None:
        words = [*words, "--cache", given.folder("Cache", request.cache, "NONE", "For image stacks, on each worker.")]
    device = request.device or ("cuda:0" if options.gpu else None)
    words = [*words, *(["--device", device] if device else []), "--progress", "openjd"]
    run: dict[str, Plain] = {"command": program, "args": words,
                             "cancelation": {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": NOTICE_S}}
    tasks: dict[str, Plain] = {"name": step}
    if space is not None:
        tasks["parameterSpace"] = space
    tasks["script"] = {"actions": {"onRun": run}}
    if options.gpu:
        tasks["hostRequirements"] = {"amounts": [{"name": "amount.worker.gpu", "min": 1}]}
    template: dict[str, Plain] = {"specificationVersion": "jobtemplate-2023-09"}
    if extensions:
        template["extensions"] = extensions
    return Job(template | {"name": name, "parameterDefinitions": given.definitions, "steps": [tasks]}, given.values)


def picture_options(request: PictureOptions) -> list[str]:
    """The words of those options that are not at their default."""
    words: list[str] = []
    if request.exposure:
        words += ["--exposure", repr(request.exposure)]
    if request.aov != (Layer.BEAUTY,):
        words += ["--aov", ",".join(request.aov)]
    if request.color_space is not None:
        words += ["--color-space", str(request.color_space)]
    if request.compression is not FrameCompression.ZIP:
        words += ["--compression", str(request.compression)]
    return words


def title(command: str, subject: Path) -> str:
    """Name of a job; what a template would fill in is left out of it."""
    subject = subject.parent if subject.is_file() else subject
    shown = "".join(character for character in subject.absolute().name if character.isprintable() and character not in "{}")
    return f"relit {command} {shown}"[:LONGEST_NAME].rstrip()
