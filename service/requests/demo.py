"""The options of `relit demo` and `relit bench`."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from service.requests.base.base import DeviceRequest, Role


class DemoRequest(DeviceRequest):
    """Solve, export and relight the shipped sample."""

    out: Annotated[Path, Role.OUTPUT] = Path("relit-demo")
    """Folder for the results."""


class BenchRequest(DeviceRequest):
    """Measure the speed of the kernels, and in the same run that of NumPy and of a plain copy."""

    repeats: Annotated[int, Field(ge=3), Role.RUN] = 9
    """Number of timed runs of each, 3 or more; medians are shown."""
