"""The options of `relit depth`, `relit scan`, `relit separate` and `relit simulate`."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo

from service.requests.base.base import (
    CAPTURE,
    Choice,
    Commas,
    DeviceRequest,
    Options,
    PixelOptions,
    Request,
    Role,
    SequenceRequest,
    Spelling,
)
from stage.model import Count, Finite, Fraction, NotNegative, Positive, Vector


def _without_blanks(given: Any) -> Any:
    return tuple(name for name in given if name) if isinstance(given, tuple) else given


def _beyond_near(far_m: float, given: ValidationInfo) -> float:
    if (near_m := given.data.get("near_m")) is not None and far_m <= near_m:
        raise ValueError(f"is {far_m:g} m, not beyond the nearest that is asked for, {near_m:g} m")
    return far_m


FarDistance = Annotated[Positive, AfterValidator(_beyond_near)]


class Ranging(Choice):
    """The technique that measures a depth."""

    PATTERN = "pattern", "structured light: frames under projected patterns"
    LASER = "laser", "frames under spots or stripes of a laser"
    TOF = "tof", "time of flight: phases or photon histograms"
    STEREO = "stereo", "two or more cameras under projected texture"


class TofFilter(Choice):
    """Filters, each asked for by name; flying pixels are taken out before anything is smoothed."""

    FLYING = "flying", "removes mixed pixels, which lie between two surfaces, and changes no other"
    BILATERAL = "bilateral", "smooths the range, but not across edges of the amplitude, and fills no hole"


class WhichReturn(Choice):
    """The return that is taken as the depth where there are several."""

    STRONGEST = "strongest"
    FIRST = "first"
    LAST = "last"


class TofChoices(Options):
    """Options of the solver for time of flight."""

    filters: Annotated[tuple[TofFilter, ...], BeforeValidator(_without_blanks), Commas, Spelling(flag="--filter")] = ()
    """Filters of time of flight, as text with commas between."""
    vote: bool = True
    """Continuous-wave time of flight: where the phases of a pixel allow several distances, let its neighbours decide, and decode pixels
    that are too dark alone together with the dark pixels around them. Photon histograms: where several times are possible, let the
    neighbours' returns decide."""
    which: Annotated[WhichReturn, Spelling(flag="--return")] = WhichReturn.STRONGEST
    """Pulsed time of flight: the return that gives the depth, where a pixel has several."""
    temperature_c: Finite | None = None
    """Temperature of the camera in °C, for a time-of-flight calibration with a temperature drift."""


class TofOptions(TofChoices):
    """Options of the solver for time of flight, with the camera's calibration."""

    calibration: Annotated[Path | None, Role.INPUT, Spelling(flag="--tof-calibration")] = None
    """Noise, wiggling, offset, drift and pulse of a time-of-flight camera: a relit.tof/1 file; None: noise and pulse are estimated from
    the capture, and nothing else is corrected."""


class DepthOptions(PixelOptions):
    """Options for decoding depth, and for the depths that are kept."""

    using: Ranging | None = None
    """The kind of frames to use; needed only where a capture has several kinds."""
    near_m: Positive | None = None
    """Nearest depth in metres; pixels below have the status out of range."""
    far_m: FarDistance | None = None
    """Farthest depth in metres; pixels above have the status out of range."""
    max_residual_px: Positive = 4.0
    """Where both column and row are decoded: how many projector pixels the decoded place may be away from where the projector sees the
    triangulated point, or three of its standard deviations if these are more."""
    refine: bool = True
    """Interpolate a Gray code with inverses between the edges of its stripes."""
    refine_projector: bool = False
    """Where columns and rows contradict the pose and the focal length of the projector, turn and zoom it so that they do not; the report
    says by how much. Needs patterns of both axes. Of two cameras it is the other one that is turned and zoomed."""
    read_noise: Positive = 0.003
    """Standard deviation of a reading in the dark, quantisation included, as a fraction of full scale; patterns and stereo only."""
    photon_gain: NotNegative = 1e-4
    """Photon noise: 1 / (electrons at full scale); patterns and stereo only."""
    tof: TofChoices = TofChoices()
    """How time of flight is solved; `near_m` and `far_m` are ranges along the ray there."""
    max_sigma: Positive | None = None
    """Largest standard deviation, in metres, of a depth that counts as solved; less certain ones are kept outside the mask, with the
    status unsure. None: any."""
    least_confidence: Fraction | None = None
    """Least confidence, 0 to 1, of a depth that counts as solved; less certain ones are kept outside the mask, with the status unsure.
    None: that of the method."""
    normals: bool = False
    """Write normals (nx, ny, nz) into points.ply too."""


class DepthRequest(DepthOptions, SequenceRequest):
    """Depth from projected patterns, a laser, time of flight, or several cameras under projected texture."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder with a capture.json; or a sequence: a folder of such folders, one a time step, with a sequence.json or in order of name."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for depth.exr, points.ply and report.json."""
    beside: Annotated[Path | None, Role.INPUT, Spelling(metavar="CAPTURE")] = None
    """Capture of a second camera under the same patterns of the same projector, which need not be calibrated: columns and rows tell which
    of its pixels sees the same place, and both cameras are triangulated by their `world_from_camera`."""
    tof: TofOptions = TofOptions()
    """How time of flight is solved, with the camera's calibration; `near_m` and `far_m` are ranges along the ray there."""


class ScanOptions(Options):
    """The range of returns that count, and the files that are written."""

    near_m: Positive | None = None
    """Returns nearer than this, in metres, are left out."""
    far_m: FarDistance | None = None
    """Returns farther than this, in metres, are left out."""
    las: bool = False
    """Write points.las (LAS 1.4) too; needs laspy: pip install 'relit[las]'."""


class ScanRequest(ScanOptions, DeviceRequest):
    """Shots of a scanning laser, from a platform that may move, as one point cloud."""

    scan: Annotated[Path, Role.INPUT, Spelling(argument=True, metavar="SCAN")]
    """A folder with a scan.json, or the file."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for points.ply, points.usdc and report.json, and points.las if `las` is given."""


class SeparateOptions(PixelOptions):
    """The frames that are used, and the black level of the projector."""

    period_px: Positive | None = None
    """Period of the phase frames to use, in projector pixels; None: the shortest of the capture, which must not exceed 64."""
    black_level: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.0
    """Light of the projector's black as a fraction of its white, for a capture without a black frame."""


class SeparateRequest(SeparateOptions, Request):
    """Direct and global light of a capture under fine, shifted phase patterns."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder with a capture.json."""
    out: Annotated[Path, Role.OUTPUT]
    """Folder for separation.exr and report.json."""


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
