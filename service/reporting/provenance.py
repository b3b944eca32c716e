"""Where a result came from: the same few lines in every EXR, USD file and report."""

import json
import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from pydantic import BaseModel

from service import __version__

REPORTED = ("relit", "warp-lang", "numpy", "OpenEXR", "OpenImageIO", "opencv-python-headless", "usd-core")
"""Distributions whose versions a report names."""

UNRECORDED = {"capture", "out", "maps", "environment", "keys", "sheet", "report", "cache", "device", "overwrite",
              "only"}
"""Of a request: paths, and how it was carried out."""


def versions() -> dict[str, str]:
    """Versions of this program and of what its results depend on."""
    found = {"python": platform.python_version()}
    for name in REPORTED:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = __version__ if name == "relit" else "not installed"
    return found


def metadata(request: BaseModel, *, capture: str, inputs: str, method: str | None = None) -> dict[str, str]:
    """String attributes for result files. Nothing in them changes between two runs on the same inputs.

    Args:
        request: what was asked; paths and device are left out, so that results do not depend on where they were made, and so is
            what was not asked for.
        capture: its name.
        inputs: content hash of the images.
        method: the one that was used, where the request left the choice open.
    """
    options = request.model_dump(mode="json", exclude=UNRECORDED)
    options = {name: value for name, value in options.items() if value is not None and value is not False}
    if method is not None:
        options["method"] = str(method)
    return {"relit:version": __version__, "relit:capture": capture, "relit:inputs": inputs,
            "relit:options": json.dumps(options, sort_keys=True)}


def report(**sections: Any) -> str:
    """The text of a report.json: the sections in the order given, then software versions."""
    return json.dumps({"schema": "relit.report/1", **sections, "versions": versions()}, indent=2) + "\n"
