"""Where the programs that open assets are installed, and what is missing.

`make clients` puts them into the folder .clients of the checkout; environment variables name other places:

RELIT_TEST_BLENDER_PYTHON   a Python 3.11 with the package bpy (Blender as a module)
RELIT_TEST_MITSUBA_PYTHON   a Python with the package mitsuba
RELIT_TEST_NODE_MODULES     a node_modules folder with three and gltf-validator, and with openlime where the package registry has it
RELIT_TEST_CHROMIUM         the browser
"""

import os
import shutil
import subprocess
from functools import cache
from pathlib import Path

HOME = Path(__file__).parents[2] / ".clients"
BROWSERS = "chromium-headless-shell", "chromium", "chromium-browser", "google-chrome"
"""The first that is there is taken. The headless shell has no windows of its own to draw: a page costs half the processor time."""


class MissingClientError(RuntimeError):
    """A program is not installed; the text says which, and how it is installed."""


def python_with(package: str, variable: str) -> Path:
    """Return a Python interpreter that can import a package.

    Args:
        package: name of the package.
        variable: the environment variable that names the interpreter.

    Raises:
        MissingClientError: there is no such interpreter.
    """
    chosen = Path(os.environ.get(variable, HOME / "bin" / "python"))
    if not chosen.exists() or not _imports(chosen, package):
        raise MissingClientError(f"{package} is missing: no {chosen} that imports it; `make clients` installs it, "
                                 f"{variable} names another Python")
    return chosen


def node_modules() -> Path:
    """Return the folder with the packages for browsers.

    Raises:
        MissingClientError: it is missing.
    """
    folder = Path(os.environ.get("RELIT_TEST_NODE_MODULES", HOME / "node_modules"))
    if not (folder / "three" / "package.json").exists():
        raise MissingClientError(f"three.js is missing: no {folder / 'three'}; `make clients` installs it, "
                                 "RELIT_TEST_NODE_MODULES names another folder")
    return folder


def openlime() -> Path:
    """Return the module of OpenLIME for browsers.

    Raises:
        MissingClientError: it is missing.
    """
    file = Path(os.environ.get("RELIT_TEST_NODE_MODULES", HOME / "node_modules")) / "openlime" / "dist" / "js" / "openlime.esm.js"
    if not file.exists():
        raise MissingClientError(f"OpenLIME is missing: no {file}; `make clients` installs it where npm's registry has the package "
                                 "openlime, RELIT_TEST_NODE_MODULES names another folder")
    return file


def browser() -> str:
    """Return the browser's program.

    Raises:
        MissingClientError: there is none.
    """
    chosen = os.environ.get("RELIT_TEST_CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
    if chosen is None:
        raise MissingClientError("Chromium is missing: install the package chromium, or name the program in RELIT_TEST_CHROMIUM")
    return chosen


@cache
def _imports(python: Path, package: str) -> bool:
    # not imported but found, because importing bpy takes seconds
    code = f"import importlib.util, sys; sys.exit(importlib.util.find_spec({package!r}) is None)"
    return subprocess.run([python, "-P", "-c", code], capture_output=True, timeout=60).returncode == 0
