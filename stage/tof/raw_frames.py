"""The raw time-of-flight frames of a capture as arrays: correlation images or photon histograms."""

from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from stage import inputs
from stage.capture.capture import Capture
from stage.capture.light import ContinuousWave, Pulsed
from stage.capture.manifest import FILE_NAME, Frame
from stage.errors import ImageError, ManifestError, storage
from stage.formats import images
from stage.formats.npy import array_shape
from stage.model import Vector

SAME_TIME = 1e-6
"""The relative difference of bin widths and starts up to which two frames have the same bins."""

Kind = TypeVar("Kind", ContinuousWave, Pulsed)


@dataclass(frozen=True)
class CorrelationImages:
    """The correlation images I(δ) = P + Q·cos(φ - δ) of a capture, in manifest order."""

    images: np.ndarray  # [images, rows · cols] float32, recorded values
    modulation_hz: np.ndarray  # [images] float64
    reference_phase_rad: np.ndarray  # [images] float64
    scale: np.ndarray  # [images] float64, factors that bring recorded values to the mean exposure
    source_m: Vector | None = None
    """The place of the light source in the camera frame; None: at the camera."""


@dataclass(frozen=True)
class Histograms:
    """The photon histograms of a capture, summed over its frames."""

    counts: np.ndarray  # [rows · cols, bins] float32
    bin_s: float
    start_s: float
    """The time of flight at which the first bin begins."""
    pulses: int | None
    first_photon_only: bool
    source_m: Vector | None = None
    """The place of the light source in the camera frame; None: at the camera."""
    count_scale: float | None = None
    """Recorded units of one photon; None: not declared."""


def is_pulsed(capture: Capture) -> bool:
    """Return whether the time-of-flight frames of a capture are photon histograms.
    Raises ManifestError if the capture has no time-of-flight frames, or both correlation images and histograms."""
    kinds = {type(frame.tof) for frame in capture.manifest.frames if frame.tof is not None}
    if len(kinds) != 1:
        what = "holds cw and pulsed frames: give one kind" if kinds else "holds no tof frame"
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames[].tof: {what}")
    return Pulsed in kinds


def read_correlations(capture: Capture) -> CorrelationImages:
    """Read the correlation images of a capture."""
    frames = _frames(capture, ContinuousWave)
    if not frames:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames[].tof: none is cw")
    values = np.stack([_plane(capture, frame).reshape(-1) for frame, _ in frames])
    exposures = np.array([frame.exposure_s or 1.0 for frame, _ in frames])
    return CorrelationImages(values, np.array([tof.modulation_hz for _, tof in frames]),
                             np.array([tof.reference_phase_rad for _, tof in frames]), exposures.mean() / exposures,
                             read_source(capture))


def read_histograms(capture: Capture) -> Histograms:
    """Read the photon histograms of a capture, and sum frames with the same bins.
    Raises ManifestError if there is none, frames have different bins, or first_photon_only is given without pulses."""
    frames = _frames(capture, Pulsed)
    if not frames:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames[].tof: none is pulsed")
    first = frames[0][1]
    _check_bins(capture, frames)
    total: np.ndarray | None = None
    for frame, _ in frames:
        counts = _histogram(capture, frame)
        if total is not None and counts.shape != total.shape:
            raise ImageError(f"{capture.file(frame.image)}: has {counts.shape[1]} bins, {frames[0][0].image} has {total.shape[1]}")
        total = counts if total is None else total + counts
    assert total is not None
    given = [tof.pulses for _, tof in frames if tof.pulses is not None]
    return Histograms(total, first.bin_s, first.start_s, sum(given) if len(given) == len(frames) else None, first.first_photon_only,
                      read_source(capture), first.count_scale)


def check_frames(capture: Capture) -> None:
    """Check that the time-of-flight frames of a capture go together: one kind, one place of the source, and the same bins."""
    if is_pulsed(capture):
        _check_bins(capture, _frames(capture, Pulsed))
    read_source(capture)


def read_frame(capture: Capture, frame: Frame) -> np.ndarray:
    """Read the recorded values of one time-of-flight frame: [rows, cols] float32 of a correlation image, which may be negative or not
    finite; [rows · cols, bins] float32 counts of histograms."""
    return _histogram(capture, frame) if isinstance(frame.tof, Pulsed) else _plane(capture, frame)


def _check_bins(capture: Capture, frames: list[tuple[Frame, Pulsed]]) -> None:
    manifest, first = capture.folder / FILE_NAME, frames[0][1]
    for frame, tof in frames:
        if (abs(tof.bin_s - first.bin_s) > SAME_TIME * first.bin_s or abs(tof.start_s - first.start_s) > SAME_TIME * first.bin_s
                or tof.first_photon_only != first.first_photon_only or tof.count_scale != first.count_scale):
            raise ManifestError(f"{manifest}: frames[].tof: the bins of {frame.image} are others than those of {frames[0][0].image}, or "
                                "its counts have another scale: give one capture for each")
        if tof.first_photon_only and tof.pulses is None:
            raise ManifestError(f"{manifest}: frames[].tof.pulses: is missing for {frame.image}: pile-up of a detector that counts first "
                                "photons only is corrected with it")


def read_source(capture: Capture) -> Vector | None:
    """Return the place of the light source of the time-of-flight frames in the camera frame, metres; None: at the camera.
    Raises ManifestError if frames have different sources."""
    places = {frame.tof.source_m: frame.image for frame in capture.manifest.frames if frame.tof is not None}
    if len(places) > 1:
        one, other = list(places.values())[:2]
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames[].tof.source_m: {one} and {other} have different sources: "
                            "give all frames the same, or one capture for each source")
    return next(iter(places), None)


def _frames(capture: Capture, kind: type[Kind]) -> list[tuple[Frame, Kind]]:
    return [(frame, frame.tof) for frame in capture.manifest.frames if isinstance(frame.tof, kind)]


def _plane(capture: Capture, frame: Frame) -> np.ndarray:
    """Read a correlation image as [rows, cols] float32 from a .npy, or from the first channel of an image."""
    path = capture.file(frame.image)
    if path.suffix.lower() != ".npy":
        images.check_resolution(path, capture.image_resolution)
        return capture.part_of(images.read_pixels(path)[..., 0]).astype(np.float32)
    values = read_array(path)
    expected = capture.image_resolution[::-1]
    if values.shape != expected:
        raise ImageError(f"{path}: is {values.shape}, the camera's image is {expected} (rows, cols)")
    return capture.part_of(values).astype(np.float32)


def _histogram(capture: Capture, frame: Frame) -> np.ndarray:
    """Read the histograms of one frame as [rows · cols, bins] float32."""
    path = capture.file(frame.image)
    if path.suffix.lower() != ".npy":
        raise ImageError(f"{path}: is no histogram: give a .npy of (rows, cols, bins)")
    values = read_array(path)
    expected = capture.image_resolution[::-1]
    if values.ndim != 3 or values.shape[:2] != expected:
        raise ImageError(f"{path}: is {values.shape}, expected {expected} and bins (rows, cols, bins)")
    if values.shape[2] < 3:
        raise ImageError(f"{path}: has {values.shape[2]} bins: a return needs three or more")
    counts = capture.part_of(values).reshape(-1, values.shape[2]).astype(np.float32)
    if not np.isfinite(counts).all() or counts.min() < 0:
        raise ImageError(f"{path}: holds counts that are negative or not finite: give photons")
    if not counts.any():
        raise ImageError(f"{path}: every histogram is empty: no photon was counted")
    return counts


def read_array(path: Path) -> np.ndarray:
    """Read a .npy file of real numbers."""
    with inputs.opened(path) as source:
        array_shape(path, source.file, source.max_pixels)
        with storage("read", path):
            return np.asarray(np.load(source.file, allow_pickle=False))
