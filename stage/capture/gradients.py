"""The spherical gradient frames of a capture as rows of a linear system, and the check that they determine a normal.

Under radiance L(ω) = mean + dipole·ω a pixel's radiance is mean · M₀ + dipole · M, with M₀ its response to the full sphere and M
its response to L = ω. A gradient (1 ± ω_a)/2 is mean 1/2 and dipole ±e_a/2; the full sphere is mean 1. So a frame is one row of
a linear system in (M₀, M), whatever the reflectance is.

Source: Ma et al., "Rapid acquisition of specular and diffuse normal maps from polarized spherical gradient illumination",
    Eurographics Symposium on Rendering 2007, section 3; opposite gradients: Wilson et al., "Temporal upsampling of performance
    geometry using photometric alignment", ACM Trans. Graphics 29(2), 2010.
"""

from typing import NamedTuple

import numpy as np

from stage.capture.capture import Capture
from stage.capture.light import FullLight, GradientLight
from stage.capture.lighting import check_surface
from stage.capture.manifest import FILE_NAME
from stage.errors import ManifestError

AXES = "xyz"


class GradientFrames(NamedTuple):
    """The row of the linear system for each frame of the stack of a capture, for each polarisation that the solver uses."""

    diffuse: np.ndarray  # [frames, 4] float64, (mean, dipole x, y, z); 0 for frames that are not used
    parallel: np.ndarray | None  # [frames, 4] float64, the rows of the parallel-polarised frames, or None
    polarised: bool
    """True when `diffuse` holds cross-polarised frames, which record half of the diffuse light and none of the specular light."""
    leak: float
    """The part of a highlight's light that crossed polarisers pass."""
    unused: tuple[str, ...]
    """The images of gradient and full frames that the solver does not use."""


def has_gradients(capture: Capture) -> bool:
    """Return whether a gradient light lit any frame of a capture."""
    return bool(capture.lit_by(GradientLight))


def gradient_frames(capture: Capture) -> GradientFrames:
    """Return the linear system of the gradient and full frames of a capture, in the order of its stack.

    When there are cross-polarised frames they are the diffuse frames, and parallel-polarised frames add the specular light;
    otherwise the unpolarised frames are used. A `full` frame, which names no polariser, counts as an unpolarised gradient frame of
    axis `full`. Raises ManifestError if there are no gradient frames, or they do not determine a normal; the message names what is
    missing."""
    where = capture.folder / FILE_NAME
    if not has_gradients(capture):
        raise ManifestError(capture.none_is_lit("a gradient light, which --method gradient needs"))
    rows: dict[str, np.ndarray] = {}
    frames = capture.sources()
    for index, frame in enumerate(frames):
        light = frame.light
        if isinstance(light, FullLight):
            light = GradientLight(type="gradient", axis="full")
        if isinstance(light, GradientLight):
            rows.setdefault(light.polarization, np.zeros((len(frames), 4)))[index] = _row(light)
    if "parallel" in rows and "cross" not in rows:
        raise ManifestError(f"{where}: frames: gradient capture has parallel frames without cross ones: separation needs both; "
                            "frames of one polariser alone are polarization none")
    polarised = "cross" in rows
    solved = [kind for kind in ("cross", "parallel") if kind in rows] if polarised else ["none"]
    for kind in solved:
        _check(f"{where}: frames: gradient capture", rows[kind], kind)
    taken = np.any([rows[kind].any(axis=1) for kind in solved], axis=0)
    unused = tuple(frame.image for frame, used in zip(frames, taken, strict=True)
                   if not used and isinstance(frame.light, GradientLight | FullLight))
    check_surface(capture)
    leak = capture.manifest.polarizer_leak or 0.0
    if leak > 0 and polarised and "parallel" not in rows:
        raise ManifestError(f"{where}: polarizer_leak: is {leak:g}, and no frame has polarization parallel: what leaks is known from these")
    return GradientFrames(rows[solved[0]], rows.get("parallel") if polarised else None, polarised, leak, unused)


def _row(light: GradientLight) -> tuple[float, float, float, float]:
    if light.axis == "full":
        return (1.0, 0.0, 0.0, 0.0)
    x, y, z = (0.5 * light.sign if light.axis == axis else 0.0 for axis in AXES)
    return (0.5, x, y, z)


def _check(what: str, rows: np.ndarray, polarization: str) -> None:
    """Raise ManifestError for rows that do not determine M₀ and all components of M."""
    lack = [axis for a, axis in enumerate(AXES) if not rows[:, 1 + a].any()]
    which = "" if polarization == "none" else f" with polarization {polarization}"
    if lack:
        raise ManifestError(f"{what} lacks axis {' and '.join(lack)}{which}: a normal needs x, y and z")
    if np.linalg.matrix_rank(rows) < 4:
        raise ManifestError(f"{what} lacks a full frame{which}, or the opposite sign of one axis: "
                            "without it albedo and normal cannot be told apart")
