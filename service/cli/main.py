"""The `relit` program: its commands, and one place that turns errors into a sentence and an exit code."""

import importlib
import io
import os
import signal
import sys
from typing import Annotated

import typer
from typer.exceptions import TyperException

from service.cli.groups import make_group

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("demo", "Solve, export and relight the shipped sample."),
    "bench": ("demo", "Measure the speed of the kernels, and in the same run that of NumPy and of a plain copy."),
    "info": ("captures", "Say what a capture holds, and what is wrong with it."),
    "view": ("captures", "Write the files that a browser needs to show a capture, its maps, its object under new light, and its "
             "depth as points."),
    "solve": ("captures", "Normals, albedo and height of a light-stage capture."),
    "relight": ("captures", "Frames under HDR environments and animated lights."),
    "shade": ("captures", "A picture of solved maps under near lights, area lights and an environment, with cast shadows."),
    "export": ("export", "A USD or glTF asset of solved maps with their material, or of a depth with its colours."),
    "blender-extension": ("export", "Write the extension that brings Relit into Blender 4.2 and later; Blender's preferences install it "
                          "from the file."),
    "inspect": ("export", "Say what an asset holds, and what is wrong with it: layers, variants, geometry, materials, textures, "
                "provenance, validators."),
    "basis": ("export", "A capture as a few coefficient images, for a browser or for RTI viewers."),
    "publish": ("export", "Publish a capture as a folder of static files, which any web server serves."),
    "join": ("export", "One surface from solved maps and a depth of the same view: the detail of the normals, and the shape and "
             "place of the depth."),
    "depth": ("depth", "Depth from projected patterns, a laser, time of flight, or several cameras under projected texture."),
    "separate": ("depth", "Direct and global light of a capture under fine, shifted phase patterns."),
    "scan": ("depth", "Shots of a scanning laser, from a platform that may move, as one point cloud."),
    "patterns": ("depth", "The images to project, and their manifest entries; or, with --plan, what each code costs."),
    "inspect-board": ("boards", "Stitch the tiles of a board to one height map, compare it with a golden map or a design, and "
                      "list what is wrong."),
    "inspect-paste": ("boards", "Measure the solder paste on every pad of a board, and judge it by limits."),
    "gauge-board": ("boards", "Repeatability and reproducibility of inspections of the same boards (gauge R&R)."),
    "board-capability": ("boards", "Capability of a print over several boards (Cp and Cpk of every pad), or of the heights of regions."),
    "register": ("scans", "Find the poses of scans of one object by their surfaces, and say how sure each is and which scans "
                 "could not be joined."),
    "fuse": ("scans", "Fuse the scans of a set, whose poses are known, into one surface."),
    "compare": ("scans", "Compare a scan with the design of the part: its deviations with their σ, and whether regions are within their "
                "tolerances."),
    "drive": ("rig", "Levels at which the lamps of a rig light a subject as environments and animated lights would."),
    "play": ("rig", "Send cues to the lamps of a rig over sACN or Art-Net, and turn the lamps dark at the end."),
    "twin": ("rig", "A stage that is not there: receive what is sent to the lamps of a rig, and show what a camera would see."),
    "capture": ("acquire", "Take a capture: switch each light or show each pattern, take the picture, check it, and write the capture "
                "folder as it goes. Given again, the command takes the pictures that are missing."),
    "doctor": ("doctor", "Check this installation: versions, shadowed packages, devices, a kernel, a writable temporary folder; "
               "and the service here."),
    "kernels": ("doctor", "Compile all kernels for GPUs ahead, so that no machine compiles them when it first launches them; needs no "
                "GPU."),
    "serve": ("server", "Run the service: the API, and a worker on each device."),
    "worker": ("server", "Run one more worker, on any machine that reaches the database and the storage."),
    "backup": ("server", "Save the database and the files of the service, which may run meanwhile, with their checksums."),
    "restore": ("server", "Make a service from a backup, in a new data folder (--data) and an empty database; jobs that ran go on "
                "when it starts."),
    "audit": ("keys", "Show who did what to which object, the newest first."),
    "simulate": ("depth", "The raw frames that a time-of-flight camera would make of a depth."),
    "rig": ("rig", "Rigs of driven lamps: check them, make them from captures, tables and scenes, plan them; docs/drive.md."),
    "keys": ("keys", "Make, list and revoke the keys of the service."),
    "import": ("imports", "Write a capture.json for files that are laid out another way; docs/importing.md shows each."),
    "calibrate": ("calibrate", "Lights, projector and cameras, dark frame, flat field, colours and saturation from images; with "
                  "residuals."),
    "submit": ("submit", "Submit work to a service, with the options of the commands that do it on this machine."),
    "jobs": ("jobs", "List the jobs of a service, wait for them, cancel, retry or resume them, and fetch their results."),
    "hooks": ("hooks", "Let a service tell a URL how the jobs of a project have ended; list, test and delete such hooks."),
    "farm": ("farm", "Jobs for render farms; docs/farm.md."),
}
"""The commands in the order of the help: the module of service.cli.commands that registers each, and its sentence in the list of commands.
The program loads the modules that it needs: to import all of them takes longer than many runs."""

ABOUT = "Active-illumination captures to normals, materials, depth, USD assets and relit frames."
BAD_INPUT, INTERRUPTED = 2, 130
BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
"""The variables by which NumPy's linear algebra is told its number of threads. Without them it has one: kernels divide the large work among
the cores, and matrices of some hundred rows cost more to divide than to solve."""


def program(wanted: str | None = None) -> typer.Typer:
    """Return the program; of a command that is `wanted` only its module is imported, else all modules are."""
    app = _empty()
    modules = [COMMANDS[wanted][0]] if wanted in COMMANDS else dict.fromkeys(module for module, _ in COMMANDS.values())
    for module in modules:
        importlib.import_module(f"service.cli.commands.{module}").register(app)
    return app


def listing() -> typer.Typer:
    """Return a program that shows the list of commands, without importing them, and can do nothing else."""
    app = _empty()
    for name, (_, words) in COMMANDS.items():
        app.command(name, help=words)(lambda: None)
    return app


def _empty() -> typer.Typer:
    app = make_group("relit", help=ABOUT)
    app.callback(invoke_without_command=True)(_root)
    return app


def _root(version: Annotated[bool, typer.Option("--version", help="Print the version and exit.", is_eager=True)] = False) -> None:
    if version:
        from service import __version__

        print(f"relit {__version__}")
        raise typer.Exit


def main() -> None:
    """Run the program; exit 2 with one sentence on bad input, 130 when interrupted."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # paths may hold bytes that are not text
    if not any(name in os.environ for name in BLAS_THREADS):  # numpy is not imported yet
        os.environ[BLAS_THREADS[0]] = "1"
    for number in (signal.SIGINT, signal.SIGTERM):  # the same tidy end, also where a shell started us in the background, without SIGINT
        signal.signal(number, signal.default_int_handler)
    try:
        app = listing() if sys.argv[1:] in ([], ["--help"]) else program(next(iter(sys.argv[1:]), None))
        code = app(prog_name="relit", standalone_mode=False)  # so that wrong options, too, are one sentence
        if code == INTERRUPTED:  # what typer makes of KeyboardInterrupt
            raise KeyboardInterrupt
        sys.exit(code)
    except KeyboardInterrupt:  # also while modules are loaded
        print("relit: interrupted; results that are there are whole, run again to finish", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except TyperException as error:
        if text := " ".join(error.format_message().replace("Value error, ", "").split()):  # else the help has been shown
            context = getattr(error, "ctx", None)
            command = "relit" if context is None else context.command_path
            print(f"relit: {text[0].lower()}{text[1:].removesuffix('.')}: see {command} --help", file=sys.stderr)
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
