"""What can be asked of a time-of-flight capture, beside the span of its ranges."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from service.tof_methods import TofFilter, WhichReturn


def _split(given: Any) -> Any:
    if isinstance(given, str):
        return tuple(part.strip() for part in given.split(",") if part.strip())
    return tuple(given) if isinstance(given, list) else given  # which strict validation of JSON asks for


class TofChoices(BaseModel):
    """How time of flight is solved."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    filters: Annotated[tuple[TofFilter, ...], BeforeValidator(_split)] = ()
    """As text, names with commas between."""
    vote: bool = True
    """Let neighbours decide between wraps that a pixel leaves open (continuous wave)."""
    which: WhichReturn = WhichReturn.STRONGEST
    """Of several returns (pulsed)."""
    temperature_c: float | None = Field(default=None, allow_inf_nan=False)
    """Of the camera, for a calibration with a temperature drift."""


class TofOptions(TofChoices):
    """The same, with the camera's calibration."""

    calibration: Path | None = None
    """A relit.tof/1 file; None: noise and pulse are estimated from the capture, nothing is corrected."""
