"""The `relit` program: its commands, and one place that turns errors into a sentence and an exit code."""

import io
import os
import signal
import sys
from typing import Annotated

import typer
from typer.exceptions import TyperException

from service.cli import (
    backup,
    boards,
    calibrate,
    captures,
    demo,
    depth,
    doctor,
    farm,
    imports,
    inspect,
    jobs,
    keys,
    light,
    scans,
    server,
    solve,
    submit,
    view,
)

app = typer.Typer(name="relit", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
                  help="Active-illumination captures to normals, materials, depth, USD assets and relit frames.")
for module in (demo, imports, captures, calibrate, solve, inspect, depth, boards, scans, light, view, doctor, server, submit, jobs, keys,
               backup, farm):
    module.register(app)

BAD_INPUT, INTERRUPTED = 2, 130


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version and exit.", is_eager=True)] = False) -> None:
    if version:
        from service import __version__

        print(f"relit {__version__}")
        raise typer.Exit


def main() -> None:
    """Run the program; exit 2 with one sentence on bad input, 130 when interrupted."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # paths may hold bytes that are not text
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # whoever ends us gets the same tidy end as one who types Ctrl-C
    try:
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


if __name__ == "__main__":
    main()
