"""The options of `relit simulate`: one frozen model for each kind of camera."""

from pathlib import Path
from typing import Annotated

from pydantic import Field

from service.requests.base.base import Commas, Options, Role, Spelling
from stage.model import Count, NotNegative, Positive, Vector


class SimulateRequest(Options):
    """The scene, and where to write the capture."""

    depth: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="DEPTH")]
    """A depth.exr, or its folder: the scene and its camera."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder of the capture."""
    albedo: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Albedo of every surface."""
    source_m: Annotated[Vector | None, Commas] = None
    """Place of the light source in the camera frame in metres, x,y,z; None: at the camera."""
    seed: int = 0
    """Seed of the noise."""
    noise: bool = True
    """Add shot and read noise."""


class SimulateCwRequest(SimulateRequest):
    """Correlation images of a continuous-wave camera."""

    modulation_hz: Annotated[tuple[Positive, ...], Commas, Field(min_length=1)] = (20e6, 30e6, 80e6)
    """Modulation frequencies in Hz, as text with commas between."""
    phases: Annotated[int, Field(ge=3)] = 4
    """Number of images for each frequency, evenly spaced in phase."""
    signal_electrons: Positive = 1e5
    """Electrons of a white surface that faces the camera at one metre, in one image."""
    ambient_electrons: NotNegative = 0.0
    """Electrons of ambient light on a white surface, in one image."""
    read_noise_electrons: NotNegative = 5.0
    """Standard deviation of the read noise, in electrons."""
    full_well: Positive | None = None
    """Electrons at which a reading saturates; None: no reading saturates."""


class SimulatePulsedRequest(SimulateRequest):
    """Photon histograms of a pulsed camera."""

    bins: Annotated[int, Field(ge=3)] = 64
    """Number of bins of a histogram."""
    bin_s: Positive = 1.5e-9
    """Length of a bin, in seconds."""
    pulse_sigma_s: Positive = 1.2e-9
    """Standard deviation of the pulse, in seconds."""
    signal_photons: Positive = 4000.0
    """Photons of a white surface that faces the camera at one metre, all pulses together."""
    background: NotNegative = 0.5
    """Photons of ambient light in each bin, all pulses together."""
    pulses: Count | None = None
    """Number of pulses; with it, only the first photon after each pulse is counted."""
