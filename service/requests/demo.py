"""What `relit demo` and `relit bench` take."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from service.requests.base import DeviceRequest, Role


class DemoRequest(DeviceRequest):
    """The main job on the shipped sample: solve, export, relight."""

    out: Annotated[Path, Role.OUTPUT] = Path("relit-demo")
    """Folder for the results."""


class BenchRequest(DeviceRequest):
    """Speed of the kernels against NumPy and against a plain copy, in the same run."""

    repeats: Annotated[int, Field(ge=3), Role.RUN] = 9
    """Timed runs of each, 3 or more; medians are shown."""
