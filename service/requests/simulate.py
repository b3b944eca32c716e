"""What can be asked of `relit simulate`: one frozen model a kind of camera."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

Above0 = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotBelow0 = Annotated[float, Field(ge=0, allow_inf_nan=False)]


def _numbers(given: Any) -> Any:
    return tuple(part.strip() for part in given.split(",")) if isinstance(given, str) else given


class SimulateRequest(BaseModel):
    """Base: the scene, and where to put the capture."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    depth: Path
    """A depth.exr, or its folder: the scene and its camera."""
    out: Path
    """Folder of the capture."""
    albedo: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Of every surface."""
    seed: int | None = 0
    """Of the noise; None: no noise."""


class SimulateCwRequest(SimulateRequest):
    """Correlation images."""

    modulation_hz: Annotated[tuple[Above0, ...], BeforeValidator(_numbers), Field(min_length=1)] = (20e6, 30e6, 80e6)
    """As text, numbers with commas between."""
    phases: Annotated[int, Field(ge=3)] = 4
    signal_electrons: Above0 = 1e5
    """Of a white surface that faces the camera at one metre, in one image."""
    ambient_electrons: NotBelow0 = 0.0
    read_noise_electrons: NotBelow0 = 5.0
    full_well: Above0 | None = None


class SimulatePulsedRequest(SimulateRequest):
    """Photon histograms."""

    bins: Annotated[int, Field(ge=3)] = 64
    bin_s: Above0 = 1.5e-9
    pulse_sigma_s: Above0 = 1.2e-9
    signal_photons: Above0 = 4000.0
    """Of a white surface that faces the camera at one metre, all pulses together."""
    background: NotBelow0 = 0.5
    """Photons a bin."""
    pulses: Annotated[int, Field(ge=1)] | None = None
    """With it, only the first photon after each pulse is counted."""
