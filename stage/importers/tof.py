"""Import of raw time-of-flight data: correlation images of continuous-wave cameras, and photon histograms."""

from collections.abc import Sequence
from itertools import product
from math import pi, radians
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from stage.errors import ManifestError
from stage.formats import images
from stage.importers.camera_options import View
from stage.importers.layout import Imported, image_names, image_resolution, write_capture
from stage.importers.raw_arrays import ArrayFiles
from stage.model import Vector
from stage.tof.light_time import range_of_delay_m, range_of_phase_m

ORDERS = ("frequency,phase", "phase,frequency")
LEAST_BINS = 3
MOST_TURN_M = 1e5
"""The longest range after which the phase of a modulation repeats: 1.5 kHz, far below any camera's."""
MOST_BIN_M = 1e3
"""The longest bin of a histogram, 7 µs; cameras have bins below 10 m."""

PEAK_SIGMAS, PEAK_FLOOR, PEAK_PART = 6.0, 0.3, 75
"""Standard deviations by which a line of counts exceeds its floor where it has a pulse, the largest part of it that the floor is, and the
percentile of its counts that the floor is: pulses are no longer than a quarter of a histogram."""
PEAK_LEAD, TRIED_LINES = 0.3, 4096
"""Part of the lines by which more must have a pulse along the other axis than along that of the bins, and number of lines that are looked
at: rightly declared scenes, empty ones and ones with ambient light or retroreflectors too, lead by 0.12 at most."""


class Plane(NamedTuple):
    """One correlation image."""

    name: str
    """The file in the capture."""
    made: np.ndarray | None
    """The values of a file that is written: [rows, cols]; None: the file is there."""
    shape: tuple[int, int]
    """Rows and columns."""


def import_correlations(
    source: Path,
    destination: Path,  # the folder of the capture. Files of one image each are placed there; images of other files are written as .npy.
    *,
    frequencies_hz: Sequence[float],  # the modulation frequencies, in the order of the images
    phases_deg: Sequence[float],  # the reference phases δ of the images of a frequency, in their order
    minus: bool,  # whether an image is P + Q cos(φ − δ); False: P + Q cos(φ + δ)
    order: str = ORDERS[0],  # what changes slowest first, one of ORDERS
    arrays: ArrayFiles | None = None,
    planes: str | None = None,  # `first` or `last`: where the images are counted in arrays of three dimensions; None: as their shape says
    source_m: Vector | None = None,  # the place of the light source; None: at the camera
    view: View | None = None,
) -> Imported:
    """Write a capture.json for correlation images of a continuous-wave camera."""
    if order not in ORDERS:
        raise ManifestError(f"--order {order}: give {' or '.join(ORDERS)}")
    slow = next((hz for hz in frequencies_hz if range_of_phase_m(2 * pi, hz) > MOST_TURN_M), None)
    if slow is not None:
        raise ManifestError(f"--frequencies-hz: {slow:g} Hz repeats after {range_of_phase_m(2 * pi, slow):.3g} m: give hertz, as in 20e6")
    arrays = arrays or ArrayFiles()
    count = len(frequencies_hz) * len(phases_deg)
    names = _array_or_image_names(source, arrays)
    found = [plane for name in names for plane in _planes(source, name, arrays, planes, count)]
    if len(found) != count:
        raise ManifestError(f"{source}: {', '.join(names)[:200]} hold {len(found)} images, {len(frequencies_hz)} frequencies of "
                            f"{len(phases_deg)} phases are {count}: choose files with --arrays")
    odd = next((plane for plane in found if plane.shape != found[0].shape), None)
    if odd is not None:
        raise ManifestError(f"{source}: {odd.name} is {_size(odd.shape)}, {found[0].name} is {_size(found[0].shape)}")
    ways = list(product(frequencies_hz, phases_deg)) if order == ORDERS[0] else [(f, p) for p, f in product(phases_deg, frequencies_hz)]
    sign = 1 if minus else -1
    rows, cols = found[0].shape
    view = view or View()
    frames = [{"image": plane.name, "tof": {"type": "cw", "modulation_hz": frequency, "reference_phase_rad": sign * radians(phase),
                                            **({} if source_m is None else {"source_m": list(source_m)})}}
              for plane, (frequency, phase) in zip(found, ways, strict=True)]
    made = {plane.name: plane.made.astype(np.float32) for plane in found if plane.made is not None}
    written = write_capture({"name": source.resolve().name, "camera": view.entry((cols, rows)), "frames": frames},
                            source / names[0], destination, folder=source, arrays=made)
    repeats = ", ".join(f"{frequency / 1e6:g} MHz repeats after {range_of_phase_m(2 * pi, frequency):.4g} m"
                        for frequency in frequencies_hz)
    return Imported(written, (
        ("images", f"{count} of {_size((rows, cols))}, from {names[0]}" + (f" to {names[-1]}" if len(names) > 1 else "")
                   + (f"; written as {next(iter(made))} and so on" if made else "")),
        ("order", "; ".join(f"{plane.name} {frequency / 1e6:g} MHz {phase:g}°"
                            for plane, (frequency, phase) in list(zip(found, ways, strict=True))[:4]) + (" …" if count > 4 else "")),
        ("signal", f"P + Q cos(φ {'−' if minus else '+'} δ); the other sign would mirror the ranges"),
        ("range", repeats),
        ("source", "at the camera" if source_m is None else "at {:g}, {:g}, {:g} m".format(*source_m)),
        ("camera", view.describe())))


def import_histograms(source: Path, destination: Path, *, bin_s: float, start_s: float = 0.0, count_scale: float | None = None,
                      pulses: int | None = None, first_photon_only: bool = False, bins: str | None = None, arrays: ArrayFiles | None = None,
                      source_m: Vector | None = None, view: View | None = None) -> Imported:
    """Write a capture.json for photon histograms; several files of one scene are frames that are added.

    Args:
        destination: the folder of the capture. .npy files of (rows, cols, bins) are placed there; other histograms are written as .npy.
        bin_s, start_s, count_scale, pulses, first_photon_only: as of `stage.capture.light.Pulsed`.
        bins: `first` or `last`: where the bins are counted; None: last, unless the counts have their pulses along the first axis.
        arrays: which files, and what they do not say themselves; its size arranges pixels that are in one row.
        source_m: the place of the light source; None: at the camera.
    """
    if range_of_delay_m(bin_s) > MOST_BIN_M:
        raise ManifestError(f"--bin-s {bin_s:g}: bins are {range_of_delay_m(bin_s):.3g} m long: give seconds, as in 1.5e-9")
    arrays = arrays or ArrayFiles()
    folder, names = (source.parent, [source.name]) if source.is_file() else (source, arrays.names(source))
    shapes: dict[str, tuple[int, ...]] = {}
    made: dict[str, np.ndarray] = {}
    for name in names:
        for index, counts in enumerate(arrays.read(folder / name)):
            histograms = _histograms(folder / name, counts, bins, arrays.size)
            if name.lower().endswith(".npy") and histograms.shape == counts.shape and bins != "first":
                shapes[name] = histograms.shape
                continue
            target = f"{Path(name).stem}_histograms{index or ''}.npy"
            shapes[target], made[target] = histograms.shape, histograms
    first, shape = next(iter(shapes.items()))
    odd = next((name for name, other in shapes.items() if other != shape), None)
    if odd is not None:
        raise ManifestError(f"{folder}: {odd} is {shapes[odd]}, {first} is {shape} (rows, cols, bins): choose files of one camera with "
                            "--arrays")
    rows, cols, count = shape
    view = view or View()
    entry: dict[str, Any] = {"type": "pulsed", "bin_s": bin_s, "start_s": start_s}
    entry |= {name: value for name, value in (("pulses", pulses), ("count_scale", count_scale)) if value is not None}
    entry |= {"first_photon_only": True} if first_photon_only else {}
    entry |= {} if source_m is None else {"source_m": list(source_m)}
    written = write_capture({"name": (source if source.is_dir() else folder).resolve().name,
                             "camera": view.entry((cols, rows)), "frames": [{"image": name, "tof": entry} for name in shapes]},
                            folder / names[0], destination, folder=folder, arrays=made)
    near, far = range_of_delay_m(start_s), range_of_delay_m(start_s + count * bin_s)
    return Imported(written, (
        ("counts", f"{_size((rows, cols))} of {count} bins, from {', '.join(names)[:200]}"
                   + (f"; written as {', '.join(made)[:200]}" if made else "")),
        ("range", f"{near:.4g} to {far:.4g} m, {1000 * range_of_delay_m(bin_s):.4g} mm a bin"),
        ("unit", "estimated from the counts: --count-scale says it" if count_scale is None else f"{count_scale:g} recorded units a photon"),
        ("source", "at the camera" if source_m is None else "at {:g}, {:g}, {:g} m".format(*source_m)),
        ("camera", view.describe())))


def _array_or_image_names(source: Path, arrays: ArrayFiles) -> list[str]:
    """Return the names of the arrays, or of the images where there is no array."""
    if arrays.files is not None:
        return arrays.names(source)
    try:
        return arrays.names(source)
    except ManifestError:
        if found := image_names(source):
            return found
        raise


def _planes(source: Path, name: str, arrays: ArrayFiles, planes: str | None, count: int) -> list[Plane]:
    """Return the correlation images of a file."""
    path = source / name
    if path.suffix.lower() in images.SUFFIXES:
        width, height = image_resolution(path)
        return [Plane(name, None, (height, width))]
    found: list[Plane] = []
    for values in arrays.read(path):
        if values.ndim not in (2, 3) or values.dtype.kind not in "fiu":
            raise ManifestError(f"{path}: is {' x '.join(map(str, values.shape))} {values.dtype}: give images of numbers")
        if values.ndim == 2:
            whole = path.suffix.lower() == ".npy"
            found.append(Plane(name if whole else f"{path.stem}_{len(found):02d}.npy", None if whole else values,
                               (values.shape[0], values.shape[1])))
            continue
        at = _counted(path, values.shape, planes, count)
        stack = np.moveaxis(values, at, 0)
        found += [Plane(f"{path.stem}_{len(found) + index:02d}.npy", plane, (plane.shape[0], plane.shape[1]))
                  for index, plane in enumerate(stack)]
    return found


def _counted(path: Path, shape: tuple[int, ...], planes: str | None, count: int) -> int:
    """Return the axis of an array of three dimensions along which images are counted."""
    if planes is not None:
        return 0 if planes == "first" else 2
    if path.suffix.lower() in (".bin", ".raw", ".dat"):
        return 0
    fitting = [axis for axis in (0, 2) if shape[axis] <= count]
    if len(fitting) != 1:
        raise ManifestError(f"{path}: is {' x '.join(map(str, shape))}: say with --planes first or last where its images are counted")
    return fitting[0]


def _peaked(counts: np.ndarray, axis: int) -> float:
    """Return the part of the lines along an axis of [a, b, c] counts that have a pulse, as nearly all histograms of a scene do."""
    lines = np.moveaxis(counts, axis, -1).reshape(-1, counts.shape[axis])
    some = lines[::-(-len(lines) // TRIED_LINES)].astype(np.float64)
    floor, top = np.percentile(some, PEAK_PART, axis=1), some.max(axis=1)
    return float(((top > floor + PEAK_SIGMAS * np.sqrt(np.maximum(floor, 0) + 1)) & (floor < PEAK_FLOOR * top)).mean())


def _histograms(path: Path, counts: np.ndarray, bins: str | None, size: tuple[int, int] | None) -> np.ndarray:
    """Return counts as (rows, cols, bins)."""
    if counts.ndim not in (2, 3) or counts.dtype.kind not in "fiub":
        raise ManifestError(f"{path}: is {' x '.join(map(str, counts.shape))} {counts.dtype}: give counts of (rows, cols, bins)")
    if bins is None and counts.ndim == 3 and min(counts.shape[0], counts.shape[2]) >= LEAST_BINS:
        first, last = _peaked(counts, 0), _peaked(counts, 2)
        if first > last + PEAK_LEAD:
            raise ManifestError(f"{path}: is {' x '.join(map(str, counts.shape))}, and {100 * first:.0f} % of its lines along the first "
                                f"axis have a pulse, {100 * last:.0f} % of those along the last: say --bins first if bins are counted "
                                "first, --bins last if they are not")
    counts = np.moveaxis(counts, 0, -1) if bins == "first" else counts
    if counts.ndim == 2:
        if size is None or size[0] * size[1] != len(counts):
            raise ManifestError(f"{path}: has {len(counts)} histograms of {counts.shape[1]} bins in a row: say with --size how many pixels "
                                "lie side by side and how many below each other, as in 3x3")
        counts = counts.reshape(size[1], size[0], counts.shape[1])
    if counts.shape[2] < LEAST_BINS:
        raise ManifestError(f"{path}: has {counts.shape[2]} bins: if they are counted first, say --bins first")
    if not np.isfinite(counts).all() or counts.min() < 0:
        raise ManifestError(f"{path}: holds counts that are negative or not finite")
    return counts


def _size(shape: tuple[int, int]) -> str:
    return f"{shape[1]}x{shape[0]} pixels"
