"""The options of `relit demo` and `relit bench`."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

import service
from service.errors import RequestError
from service.requests.base.base import DeviceRequest, Role

SAMPLE = "owl"


def sample_folder() -> Path:
    """Return the folder of the shipped sample, inside the installed package or in the checkout."""
    package = Path(service.__file__).resolve().parent
    for folder in (package / "samples" / SAMPLE, package.parent / "samples" / SAMPLE):
        if (folder / "capture.json").exists():
            return folder
    raise RequestError(f"the sample capture {SAMPLE} is not installed: run the demo from a checkout of relit")


class DemoRequest(DeviceRequest):
    """Solve, export and relight the shipped sample."""

    out: Annotated[Path, Role.OUTPUT] = Path("relit-demo")
    """Folder for the results."""


class BenchRequest(DeviceRequest):
    """Measure the speed of the kernels, and in the same run that of NumPy and of a plain copy."""

    repeats: Annotated[int, Field(ge=3), Role.RUN] = 9
    """Number of timed runs of each, 3 or more; medians are shown."""
