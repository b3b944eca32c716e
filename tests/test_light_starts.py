"""What a program has loaded as it starts: no library that it does not need, each of which takes tenths of a second and memory."""

import subprocess
import sys

from tests.test_architecture import HOME


def test_the_command_line_starts_without_heavy_libraries():
    heavy = ("warp", "pxr", "OpenEXR", "OpenImageIO", "PyOpenColorIO", "numpy", "scipy", "cv2", "MaterialX", "pygltflib",
             "fast_simplification", "gerbonara", "laspy", "rawpy", "small_gicp", "xatlas")
    code = ("import contextlib, sys, service.cli.main\n"
            "for command in [], ['solve'], ['relight']:\n"
            "    sys.argv[1:] = *command, '--help'\n"
            "    with contextlib.suppress(SystemExit): service.cli.main.main()\n"
            f"print([name for name in {heavy!r} if name in sys.modules])")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=HOME, timeout=60, check=True)
    assert done.stdout.count("Usage:") == 3 and done.stdout.splitlines()[-1] == "[]"


def test_images_are_read_without_opencv():
    """It takes a tenth of a second to start, which only AVIF and camera raw need."""
    code = "import sys, service.solve.solve; print('cv2' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=HOME, timeout=60, check=True)
    assert done.stdout.strip() == "False"


def test_the_client_starts_without_heavy_libraries():
    """A pipeline's interpreter loads no server, database, image library or device, even when it makes a client and a job."""
    heavy = ("fastapi", "starlette", "dbos", "uvicorn", "sqlalchemy", "numpy", "warp", "OpenEXR", "OpenImageIO", "PyOpenColorIO", "cv2",
             "pxr", "typer", "kernels", "service.server", "service.solve", "stage.formats.images", "stage.capture.capture")
    code = ("import sys; from service.client import Client; from service.requests.jobs import SolveJob; Client().close(); "
            f"print([name for name in {heavy!r} if name in sys.modules])")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=HOME, timeout=60, check=True)
    assert done.stdout.strip() == "[]"


def test_what_watches_workers_starts_without_what_they_need():
    """First the process that starts the others, and on top of it the one that serves."""
    heavy = {"service.server.process.processes": ("numpy", "warp", "alembic", "dbos", "fastapi", "service.server.jobs.worker",
                                                  "service.requests.jobs"),
             "service.server.process.serve": ("numpy", "warp", "alembic", "service.solve")}
    code = (f"import importlib, sys\nfor process, heavy in {heavy!r}.items():\n"
            "    importlib.import_module(process); print([name for name in heavy if name in sys.modules])")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=HOME, timeout=60, check=True)
    assert done.stdout.split() == ["[]", "[]"]
