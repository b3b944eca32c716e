"""The `relit` program: its commands, and one place that turns errors into a sentence and an exit code."""

import atexit
import gc
import importlib
import io
import os
import signal
import sys
from typing import Annotated

import typer
from typer.exceptions import TyperException

from service.cli.groups import make_group
from service.cli.listing import listing_program

COMMANDS: dict[str, tuple[str, ...]] = {
    "demo": ("demo", "bench"),
    "imports": ("import",),
    "captures": ("info",),
    "calibrate": ("calibrate",),
    "solve": ("solve",),
    "export": ("export", "basis", "join"),
    "inspect": ("inspect",),
    "depth": ("depth", "separate", "scan", "simulate", "patterns"),
    "boards": ("inspect-board", "gauge-board"),
    "scans": ("register", "fuse"),
    "light": ("relight", "shade"),
    "view": ("view",),
    "doctor": ("doctor",),
    "server": ("serve", "worker"),
    "submit": ("submit",),
    "jobs": ("jobs",),
    "keys": ("keys", "audit"),
    "backup": ("backup", "restore"),
    "farm": ("farm",),
}
"""The modules of service.cli in the order of the help, and the commands that each registers. A command that is missing here is found by
loading all modules."""

ABOUT = "Active-illumination captures to normals, materials, depth, USD assets and relit frames."
BAD_INPUT, INTERRUPTED = 2, 130
BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
"""The variables by which NumPy's linear algebra is told its number of threads. Without them it has one: kernels divide the large work among
the cores, and matrices of some hundred rows cost more to divide than to solve."""

NEW_OBJECTS = 200_000
"""Python looks for unreachable cycles of objects after so many new ones, not after 700: imports and a short run make somewhat fewer, which
stay, and to look through them time and again is a tenth of the run. No array of a solve is in a cycle: memory does not wait."""


def program(wanted: str | None = None) -> typer.Typer:
    """Return the program; where `wanted` is a command, only those of its module: to import the others takes as long as a short run."""
    app = make_group("relit", help=ABOUT)
    app.callback(invoke_without_command=True)(_root)
    beside = [module for module, names in COMMANDS.items() if wanted in names]
    for module in beside or COMMANDS:
        importlib.import_module(f"service.cli.{module}").register(app)
    return app


def _lister() -> typer.Typer:
    """Return a program that can show what `program` lists, without importing the commands."""
    app = listing_program(help=ABOUT)
    app.callback(invoke_without_command=True)(_root)
    return app


def _root(version: Annotated[bool, typer.Option("--version", help="Print the version and exit.", is_eager=True)] = False) -> None:
    if version:
        from service import __version__

        print(f"relit {__version__}")
        raise typer.Exit


def main() -> None:
    """Run the program; exit 2 with one sentence on bad input, 130 when interrupted."""
    gc.set_threshold(NEW_OBJECTS)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # paths may hold bytes that are not text
    if not any(name in os.environ for name in BLAS_THREADS):  # numpy is not imported yet
        os.environ[BLAS_THREADS[0]] = "1"
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # whoever ends us gets the same tidy end as one who types Ctrl-C
    try:
        app = _lister() if sys.argv[1:] in ([], ["--help"]) else program(next(iter(sys.argv[1:]), None))
        code = app(standalone_mode=False)  # so that wrong options, too, are one sentence
        if code == INTERRUPTED:  # what typer makes of KeyboardInterrupt
            print("relit: interrupted; results that are there are whole, run again to finish", file=sys.stderr)
        sys.exit(code)
    except TyperException as error:
        if text := " ".join(error.format_message().replace("Value error, ", "").split()):  # else the help has been shown
            print(f"relit: {text[0].lower()}{text[1:].removesuffix('.')}: see relit --help", file=sys.stderr)
        sys.exit(error.exit_code)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the reader of our output is gone
        sys.exit(1)
    except Exception as error:
        from service.errors import USER_ERRORS, sentences

        if isinstance(error, OSError) and error.filename is not None and error.strerror:  # of a path that was given: too long, no folder …
            print(f"relit: {ascii(str(error.filename))[1:-1]}: {error.strerror.lower()}", file=sys.stderr)
        elif isinstance(error, USER_ERRORS):
            for line in sentences(error):
                print(f"relit: {line}", file=sys.stderr)
        else:
            raise
        sys.exit(BAD_INPUT)


def run() -> None:
    """Run the program as a process, which ends without taking apart what it holds: the system frees the memory of a process at once.

    Python would look through all objects for garbage several times, and free them one by one, which is a sixth of a short solve. All
    threads and exit handlers end before, and an error that `main` does not name ends the process as Python does.
    """
    status: list[int] = []
    atexit.register(_leave, status)  # the first handler that is registered is the last that is called
    try:
        main()
    except SystemExit as ended:
        if ended.code is None or isinstance(ended.code, int):
            status.append(ended.code or 0)
        raise


def _leave(status: list[int]) -> None:
    """End the process with its exit status, if it has one, once all that was printed is on its way."""
    if not status:
        return
    try:
        print(end="", flush=True)
        print(end="", file=sys.stderr, flush=True)
    except OSError:
        return  # Python meets the same error at its own end, and says so
    os._exit(status[0])


if __name__ == "__main__":
    run()
