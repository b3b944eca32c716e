"""relit submit: the work of most commands, done by a service; and solve, export and relight in one job, pipeline."""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from service.cli.groups import make_group
from service.cli.progress import ProgressBar
from service.cli.remote import CancelOption, KeyOption, ResultsOption, ServerOption, WaitOption, connected, make_folder, wait_for
from service.cli.request_commands import Given, command
from service.errors import RequestError
from service.requests.base.base import JobRequest
from service.requests.base.identifiers import ALPHABET, CAPTURE, DEFAULT_SERVER, ENVIRONMENT, LENGTH, pattern
from service.requests.base.options import Option, help_text, is_document, options_of
from service.requests.jobs import JOBS
from service.requests.light.frame_range import frame_numbers
from stage.records import read_record

if TYPE_CHECKING:
    from service.client import Client

REGISTERED = "server:"
SOURCES = "Give a path of this machine, which is uploaded; an identifier, {prefix}_…; or server:/path, which is registered."


def register(app: typer.Typer) -> None:
    """Add the commands."""
    group = make_group(help="Submit work to a service, with the options of the commands that do it on this machine.")
    for name, job in JOBS.items():
        command(group, name, _submission(job), words=_words)
    app.add_typer(group, name="submit")


def _submission(job: type[JobRequest]) -> Callable[..., None]:
    def submit(given: Given[job], server: ServerOption = DEFAULT_SERVER, key: KeyOption = None,  # type: ignore[valid-type]
               wait: WaitOption = False, out: ResultsOption = None, cancel_on_interrupt: CancelOption = False) -> None:
        inputs = {option.name: prefix for option in options_of(job) if (prefix := _prefix(option)) and option.name in given.values}
        if "frames" in given.values:
            frame_numbers(given.values["frames"], 1)
        for option in options_of(job):
            if is_document(option.kind) and option.name in given.values:
                given.values[option.name] = read_record(given.values[option.name], option.kind)
        chosen = {name: _each(given.values[name], partial(_placeholder, prefix)) for name, prefix in inputs.items()}
        request: JobRequest = given.build(**chosen)
        with connected(server, key) as client:
            if out is not None:
                make_folder(out)  # before hours of waiting
            sent = {name: _each(given.values[name], partial(_send, client, prefix)) for name, prefix in inputs.items()}
            submitted = client.jobs.submit(request.model_copy(update=sent))
            print(f"job         {submitted.id}", flush=True)
            if wait or out is not None:
                wait_for(client, submitted.id, out=out, cancel_on_interrupt=cancel_on_interrupt)

    return submit


def _each(given: str | list[str], identify: Callable[[str], str]) -> str | tuple[str, ...]:
    return identify(given) if isinstance(given, str) else tuple(map(identify, given))


def _placeholder(prefix: str, given: str) -> str:
    """Return an identifier in place of what was given, with which a request is refused before files are sent.
    Raises RequestError: a folder is given as an environment, or a file as a capture."""
    if prefix == ENVIRONMENT and Path(given).is_dir():
        raise RequestError(f"{given}: is a folder: an environment is one lat-long .exr or .hdr")
    if prefix == CAPTURE and Path(given).is_file():
        raise RequestError(f"{given}: is a file: give the folder of the capture")
    return f"{prefix}_{ALPHABET[0] * LENGTH}"


def _send(client: "Client", prefix: str, given: str) -> str:
    """Upload or register what a job reads, where it is no identifier already; return its identifier."""
    what, intakes = ("capture", client.captures) if prefix == CAPTURE else ("environment", client.environments)
    path = Path(given)
    if given.startswith(REGISTERED):
        found = intakes.register(given.removeprefix(REGISTERED))
    elif not path.exists() and re.fullmatch(pattern(prefix), given):
        return given
    else:
        with ProgressBar() as bar:
            found = intakes.upload(path, progress=bar)
    print(f"{what:<11} {found.id}", flush=True)
    return found.id


def _prefix(option: Option) -> str | None:
    """Return the prefix of the identifiers that an option takes, where it is a capture or an environment."""
    return next((prefix for prefix in (CAPTURE, ENVIRONMENT) if pattern(prefix) == option.pattern), None)


def _words(option: Option, model: type[JobRequest]) -> str:
    prefix = _prefix(option)
    return help_text(option, model) + ("" if prefix is None else f" {SOURCES.format(prefix=prefix)}")
