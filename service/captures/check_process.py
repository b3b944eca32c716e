"""A process that checks one capture or environment, or looks what other files are and imports them: the files are untrusted, and their
decoders may crash, hang or ask for memory.

`check_in_process` and the functions beside it start it with an environment of its own, without the settings of the service (the database's
password among them). It has limits of memory, processor time and the size of files. What becomes of it concerns only that check.

It reads one line of JSON from its standard input, and answers with lines of JSON: {"stage": …, "total": …} and {"done": …} as it goes on,
and at last {"facts": …}, {"error": sentence} or {"fault": traceback}.
"""

import json
import os
import resource
import selectors
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from service.errors import USER_ERRORS, RequestError, sentence
from service.reporting.progress import Progress
from service.requests.base.import_choices import ImportChoices
from stage.colour.location import VARIABLE, location

KEPT = ("PATH", "LANG", "LC_ALL", "LC_CTYPE", "TMPDIR", "LD_LIBRARY_PATH", VARIABLE)
"""Variables of the environment that such a process inherits."""


def bare_environment() -> dict[str, str]:
    """Return an environment without the settings of the service, in which Python finds the same modules."""
    kept = {name: os.environ[name] for name in KEPT if name in os.environ}
    if VARIABLE in kept:
        kept[VARIABLE] = location()
    path = os.pathsep.join(os.path.abspath(entry) for entry in sys.path)
    return kept | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1", "OPENBLAS_NUM_THREADS": "1"}


def limit(**most: int) -> None:
    """Set limits of this process, by the names of `resource` without RLIMIT_: bytes or seconds. It writes no core file."""
    for name, wanted in (most | {"CORE": 0}).items():
        kind = getattr(resource, f"RLIMIT_{name}")
        _, hard = resource.getrlimit(kind)
        allowed = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        resource.setrlimit(kind, (allowed, allowed))


MEMORY_BYTES = 2 << 30
"""Bytes of data that a check may have; the largest capture.json takes a third."""
CPU_S = 300
"""Seconds of processor time of a check: headers of 20 000 images take 20."""
FILE_BYTES, IMPORTED_BYTES = 1 << 16, 4 << 30
"""Bytes of a file that a check may write, as Python tries out its folder for temporary files; and an import, which may write arrays."""
WALL_S = 1800.0
"""Seconds after which a check is ended, whatever it waits for."""
ANSWER_BYTES = 1 << 20
"""Bytes that a check may answer with."""
LOOK_S = 0.5
"""Seconds between two signs of life to the job."""
COMMAND = (sys.executable, "-P", "-m", __name__)
PYTHON_FAILED = 1
"""Exit code of Python after an exception that nobody caught."""
END_S = 5.0
"""Seconds that a process which has closed its output may take to end."""


def check_in_process(folder: Path, *, environment: bool, root: Path | None, max_pixels: int, progress: Progress) -> dict[str, Any]:
    """Check a capture or an environment in a process of its own.
    `folder`: of the capture or the environment, or the file of a registered environment. `root`: the folder below which a registered one
    lies, so that no link is followed out of its folder; None: it was uploaded. `progress`: of the check; an exception that it raises ends
    the process. Returns the description that `service.captures.admit` returns. Raises RequestError if the files cannot be used; the
    sentence names them below the folder. Raises RuntimeError for an error in relit; the message is its traceback."""
    return _ask({"do": "check", "folder": str(folder), "environment": environment, "root": None if root is None else str(root),
                 "max_pixels": max_pixels}, progress)


def propose_in_process(folder: Path, *, max_pixels: int, progress: Progress) -> dict[str, Any]:
    """Return what `service.captures.importing.propose` returns for a folder; errors are those of `check_in_process`."""
    return _ask({"do": "propose", "folder": str(folder), "max_pixels": max_pixels}, progress)


def import_in_process(folder: Path, choices: ImportChoices, assumed: tuple[str, ...], name: str, *, max_pixels: int,
                      progress: Progress) -> None:
    """Do `service.captures.importing.import_chosen` in a process of its own; errors are those of `check_in_process`."""
    _ask({"do": "import", "folder": str(folder), "choices": choices.model_dump(mode="json"), "assumed": assumed, "name": name,
          "max_pixels": max_pixels}, progress)


def _ask(asked: dict[str, Any], progress: Progress) -> dict[str, Any]:
    with ExitStack() as ended:
        errors = ended.enter_context(tempfile.TemporaryFile())
        process = ended.enter_context(subprocess.Popen(COMMAND, env=bare_environment(), cwd=os.sep, stdin=subprocess.PIPE,
                                                       stdout=subprocess.PIPE, stderr=errors, start_new_session=True))
        assert process.stdin is not None and process.stdout is not None
        ended.callback(process.kill)
        try:
            process.stdin.write(json.dumps(asked).encode() + b"\n")
            process.stdin.flush()
        except BrokenPipeError:  # it could not start: the exit code tells
            with suppress(BrokenPipeError):  # of what was not sent, which closing sends once more
                process.stdin.close()
        answer = _answer(process, progress)
        if answer is None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(END_S)
            if process.returncode == PYTHON_FAILED:
                errors.seek(0)
                raise RuntimeError(errors.read(ANSWER_BYTES).decode(errors="replace")[-4000:])
            raise RequestError(_end(process.returncode))
    if "error" in answer:
        raise RequestError(str(answer["error"]))
    if "facts" not in answer:
        raise RuntimeError(str(answer.get("fault")))
    return dict(answer["facts"])


def _answer(process: "subprocess.Popen[bytes]", progress: Progress) -> dict[str, Any] | None:
    """Return the last line of the process, or None if it ended without one."""
    assert process.stdout is not None
    descriptor, rest, read, done = process.stdout.fileno(), b"", 0, 0
    deadline = time.monotonic() + WALL_S
    with selectors.DefaultSelector() as waiting:
        waiting.register(descriptor, selectors.EVENT_READ)
        while True:
            progress.advance(done)
            if time.monotonic() > deadline:
                raise RequestError(f"the check of the files was ended after {WALL_S:g} seconds")
            if not waiting.select(LOOK_S):
                continue
            block = os.read(descriptor, 1 << 16)
            read += len(block)
            if not block or read > ANSWER_BYTES:
                return None
            *lines, rest = (rest + block).split(b"\n")
            for line in lines:
                found = json.loads(line)
                if "stage" in found:
                    done = 0
                    progress.stage(str(found["stage"]), int(found["total"]))
                elif "done" in found:
                    done = int(found["done"])
                else:
                    return dict(found)


def _end(code: int | None) -> str:
    if code is not None and -code in (signal.SIGXCPU, signal.SIGKILL):
        return (f"the check of the files was ended: it takes more than {CPU_S} seconds of processor time "
                f"or {MEMORY_BYTES >> 30} GiB of memory")
    return f"the check of the files broke off (exit code {code}): one of them is damaged"


class _Lines:
    """A Progress that is written to the standard output."""

    def stage(self, name: str, total: int) -> None:
        """Write that a stage begins."""
        _write({"stage": name, "total": total})

    def advance(self, done: int) -> None:
        """Write how many steps of the stage are done."""
        _write({"done": done})


def _write(line: dict[str, Any]) -> None:
    os.write(_answers, json.dumps(line).encode() + b"\n")


_answers = 1
"""Descriptor of the pipe to the service."""


def _end_with_parent() -> None:
    sys.stdin.buffer.read()  # until its end: the worker is gone
    os._exit(3)


def _done(folder: Path, asked: dict[str, Any]) -> dict[str, Any]:
    """Do what is asked, and return the facts that were found."""
    from stage import inputs

    if asked["do"] == "check":
        from service.captures.admit import admit_capture, admit_environment

        with ExitStack() as held:
            if asked["root"] is not None:
                top = folder.parent if asked["environment"] else folder
                held.enter_context(inputs.confined(top, Path(asked["root"]), max_pixels=asked["max_pixels"]))
            return (admit_environment(folder, max_pixels=asked["max_pixels"]) if asked["environment"] else
                    admit_capture(folder, max_pixels=asked["max_pixels"], progress=_Lines()))
    from service.captures.importing import import_chosen, propose

    inputs.enclose()
    with inputs.confined(folder, folder, max_pixels=asked["max_pixels"]):
        if asked["do"] == "propose":
            return propose(folder)
        import_chosen(folder, ImportChoices.model_validate(asked["choices"]), tuple(asked["assumed"]), asked["name"])
        return {}


def main() -> None:
    """Do the check that the first line of the standard input names."""
    global _answers
    _answers = os.dup(sys.stdout.fileno())
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # libraries print there what they find wrong
    asked = json.loads(sys.stdin.buffer.readline())
    limit(DATA=MEMORY_BYTES, CPU=CPU_S, FSIZE=IMPORTED_BYTES if asked["do"] == "import" else FILE_BYTES)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    folder = Path(asked["folder"])
    try:
        facts = _done(folder, asked)
        _write({"facts": facts})
    except MemoryError:
        _write({"error": f"the files take more than {MEMORY_BYTES >> 30} GiB of memory to be checked"})
    except USER_ERRORS as error:  # the user knows the files by the names given, not by their place on the server
        _write({"error": sentence(error).replace(f"{folder}/", "").replace(str(folder), "the folder" if folder.is_dir() else folder.name)})
    except Exception:
        _write({"fault": traceback.format_exc()[-100_000:]})
    os._exit(0)


if __name__ == "__main__":
    main()
