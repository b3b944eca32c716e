"""The options of `relit import tof`, `histogram` and `kinect`."""

from pathlib import Path
from typing import Annotated

from service.requests.base.base import Choice, Commas, Role, Spelling, WidthHeight
from service.requests.imports.base import CameraOptions, ImportRequest
from stage.model import Count, Finite, Line, Positive, Resolution


class Signal(Choice):
    """How a correlation image depends on its reference phase δ."""

    MINUS = "minus", "P + Q cos(φ − δ)"
    PLUS = "plus", "P + Q cos(φ + δ)"


class TofOrder(Choice):
    """The order in which frequency and phase change from image to image, slowest first."""

    FREQUENCY_PHASE = "frequency,phase"
    PHASE_FREQUENCY = "phase,frequency"


class End(Choice):
    """Where something is counted in an array of three dimensions."""

    FIRST = "first"
    LAST = "last"


class ArrayOptions(CameraOptions):
    """The files that hold arrays, and their layout where the files do not state it."""

    arrays: Annotated[Line | None, Spelling(metavar="GLOB")] = None
    """Names of the files, such as 'phase*.npy', taken in natural order; None: every .npy, .npz, .mat, .json, .bin, .raw and .dat file."""
    variable: Annotated[tuple[Line, ...], Commas, Spelling(metavar="NAME,…")] = ()
    """Variables of .mat and .npz files, or places in .json files such as 0.hists; None: the only array."""
    size: Annotated[Resolution | None, WidthHeight, Spelling(metavar="320x240")] = None
    """Width and height of an image in raw files (.bin, .raw, .dat), or of histograms that are in one row."""
    dtype: Line | None = None
    """Type of the numbers in raw files: uint16, int16, float32 and so on, with > in front for the other order of bytes."""
    source_m: Annotated[tuple[Finite, Finite, Finite] | None, Commas, Spelling(metavar="X,Y,Z")] = None
    """Place of the light source in the camera frame, metres; None: at the camera."""


class TofImport(ArrayOptions, ImportRequest):
    """Correlation images of a continuous-wave time-of-flight camera: arrays (.npy, .npz, .mat, raw) or images."""

    frequencies_hz: Annotated[tuple[Positive, ...], Commas, Spelling(metavar="HZ,…")]
    """Modulation frequencies, in the order of the images."""
    phases_deg: Annotated[tuple[Finite, ...], Commas, Spelling(metavar="DEG,…")]
    """Reference phases δ of the images of each frequency, in their order: 0,90,180,270 for most cameras."""
    signal: Signal
    """Sign of δ: with the other one ranges run backwards."""
    order: TofOrder = TofOrder.FREQUENCY_PHASE
    """The order in which frequency and phase change, slowest first."""
    planes: End | None = None
    """Where images are counted in arrays of three dimensions; None: as their shape says."""


class HistogramImport(ArrayOptions, ImportRequest):
    """Photon histograms of a SPAD or another pulsed camera: arrays of counts (.npy, .npz, .mat, .json). SRC may be one file."""

    bin_s: Positive
    """Width of a bin, seconds."""
    start_s: Finite = 0.0
    """Time of flight at which the first bin begins, seconds."""
    count_scale: Positive | None = None
    """Recorded units of one photon, where counts were multiplied or averaged; None: estimated from the counts."""
    pulses: Count | None = None
    """Laser pulses of each histogram, for pile-up."""
    first_photon_only: bool = False
    """The detector counts the first photon of a pulse alone: pile-up is corrected with `pulses`."""
    bins: End | None = None
    """The axis of the arrays along which the bins are counted; None: the last, and arrays whose pulses run along the first are refused."""


class KinectImport(CameraOptions, ImportRequest):
    """A raw depth packet of the Kinect v2 as libfreenect2's DumpPacketPipeline has it, with the P0 tables of the device."""

    packet: Annotated[Path | None, Role.INPUT] = None
    """Depth packet; None: the only file in SRC of its size, 2984960 bytes."""
    p0: Annotated[Path | None, Role.INPUT] = None
    """Response with the P0 tables; None: the only file in SRC with p0 in its name."""
