"""The input and the solution of every solver, and the judgement of a solution: pixels in doubt, lights that do not fit."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from kernels.device import to_numpy
from kernels.images import ImagesOnDevice
from kernels.photometric.lambertian.lambert import NormalFit
from kernels.photometric.lambertian.readings import Lights, channel_weights
from kernels.photometric.model.samples import evenly
from kernels.status import ESTIMATED, SOLVED, Status, refuse_unsure
from kernels.surface.integrate import Integration
from service.light_estimation.lambertian import LEAST_PIXELS, suspects
from service.reporting.progress import Timings
from service.sharing.sharing import SharedSolve
from stage.capture.camera import Camera
from stage.colour.colour import GREY_WEIGHTS
from stage.formats.exr import HALF_MAX
from stage.stack.stack import Stack

AMBIGUOUS_DEGREES = 5.0
"""Standard error of a normal above which it is ambiguous."""
MANY_AMBIGUOUS = 0.25
"""Part of the solved pixels with an ambiguous normal from which it is said."""
NEIGHBOURS = 8
"""Samples from which the error of a pixel between them is taken."""
PIXELS_AT_ONCE = 1 << 16
"""Number of pixels that are looked at in one piece: it bounds the memory."""
SUSPECT_PIXELS = 512
"""Number of pixels, spread over the object, on which the lights are compared."""


class SeparatedPairs(NamedTuple):
    """The polarised images of a capture beside the diffuse ones, which are the stack of the solve."""

    specular: Stack
    whole: Stack
    """Sums of both images of every pair: what a camera without polariser would see."""
    facts: dict[str, Any]
    warnings: list[str]


@dataclass(frozen=True)
class SolveInput:
    """The images of a capture, and how they are worked on."""

    stack: Stack
    camera: Camera
    mask: np.ndarray  # [rows, cols] bool: the pixels to solve
    devices: tuple[str, ...]
    """Devices for bands and batches, one or more; work on the whole object is done on the first."""
    timings: Timings
    cache: Path | None = None
    """Folder for stack caches; None: `.relit` in the folder of each capture."""
    relative: bool = False
    """True if the irradiance of all lights lacks one common factor, so that the scale of albedo is unknown."""
    refine_intensities: bool = True
    """True if a solver may replace the intensities of the lights by those that the object asks for."""
    sharing: SharedSolve | None = None
    """The part of this worker in a solve that several share; None: it is alone."""
    pairs: SeparatedPairs | None = None
    """The other images of polarised pairs, of which the stack holds the diffuse ones; None: the images are not polarised."""

    @property
    def device(self) -> str:
        """The first device."""
        return self.devices[0]

    @property
    def whole(self) -> "SolveInput":
        """The same with all light that arrives: the sum of both images of polarised pairs."""
        return self if self.pairs is None else replace(self, stack=self.pairs.whole, pairs=None)

    @cached_property
    def images(self) -> dict[str, ImagesOnDevice[Stack]]:
        """The images on each device."""
        return {device: ImagesOnDevice(self.stack, device) for device in set(self.devices)}


class SuspectLight(NamedTuple):
    """A light that disagrees with the others."""

    image: str
    misfit: float
    """The misfit of `service.light_estimation.lambertian`."""


@dataclass
class Solution:
    """The solution at every pixel of the image; only pixels with a status of kernels.status.ESTIMATED have values."""

    normal: np.ndarray  # [3, pixels] float32
    albedo: np.ndarray  # [3, pixels] float16
    sigma: np.ndarray  # [pixels] float16, standard error of the normal: the RMS angle to the true one, degrees
    residual: np.ndarray  # [pixels] float16
    status: np.ndarray  # [pixels] uint8
    albedo_own: np.ndarray | None = None  # [3, pixels] float16, standard deviation of the albedo where the normal is right; None: unknown
    albedo_tilt: np.ndarray | None = None  # [3, pixels] float16, change of it for each degree that the normal is off; None: likewise
    specular: np.ndarray | None = None  # [3, pixels] float16, F0
    roughness: np.ndarray | None = None  # [pixels] float16
    abundance: np.ndarray | None = None  # [pixels] float16, share of the first of two materials; 0 where the pixel has one
    pair: np.ndarray | None = None  # [pixels] uint8, which pair these are
    pairs: np.ndarray | None = None  # [pairs, 2, 4] float32, F0 and roughness of both materials; None: no pixel has two
    blurred: np.ndarray | None = None  # [n] positions of metals that were found by the moments of their readings; None: of none
    brushed: np.ndarray | None = None  # [n] positions of pixels with a streak for a highlight; None: of none
    specular_normal: np.ndarray | None = None  # [3, pixels] float32
    regime: np.ndarray | None = None  # [pixels] uint8, codes of kernels.photometric.posterior.sampling.Regime
    height: np.ndarray | None = None  # [rows, cols] float32, camera-frame z, 0 where not solved; None: not integrated yet
    integration: Integration | None = None
    """The last integration of the normals, from which the height came."""
    suspects: list[SuspectLight] = field(default_factory=list)
    shared_misfit: float | None = None
    """Share of the misfit that neighbouring pixels have in common, by which the surface judges sigma; None: no surface judges."""
    warnings: list[str] = field(default_factory=list)
    """A sentence for each thing that does not fit on the whole object: what it is, and what to try."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Facts for the report, under `found`."""
    contents: dict[str, str] = field(default_factory=dict)
    """Content hash of each capture that was read beside the images, by the name of its option."""

    def standard_error(self) -> np.ndarray:
        """Return the standard error of the normals in degrees, [pixels] float32."""
        return self.sigma.astype(np.float32)

    def albedo_sigma(self, pixels: slice | np.ndarray = slice(None)) -> np.ndarray | None:
        """Return the standard deviation of the albedo of pixels, [3, n] float16, without that of its scale; None where it is not known."""
        if self.albedo_own is None or self.albedo_tilt is None:
            return None
        return half(np.hypot(self.albedo_own[:, pixels].astype(np.float32), self.albedo_tilt[:, pixels] * self.standard_error()[pixels]))

    def whole_metals(self) -> np.ndarray | None:
        """Return F0, [3, pixels], 0 of blurred metals, whose outlines are ragged; None where the method estimates none."""
        if self.specular is None or self.blurred is None:
            return self.specular
        specular = self.specular.copy()
        specular[:, self.blurred] = 0
        return specular

    @property
    def mostly_brushed(self) -> bool:
        """Whether more than half of the pixels that have a normal are brushed."""
        return self.brushed is not None and 2 * len(self.brushed) > np.isin(self.status, ESTIMATED).sum()

    @property
    def confidence(self) -> np.ndarray:
        """Return 1 / (1 + standard error / 1°), [pixels] float16; 0 where nothing is estimated."""
        return np.where(np.isin(self.status, ESTIMATED), 1 / (1 + self.standard_error()), 0).astype(np.float16)

    @classmethod
    def empty(cls, pixels: int) -> "Solution":
        """Return a solution in which no pixel is solved."""
        return cls(np.zeros((3, pixels), np.float32), np.zeros((3, pixels), np.float16), np.zeros(pixels, np.float16),
                   np.zeros(pixels, np.float16), np.zeros(pixels, np.uint8))

    def place(self, span: slice, inside: np.ndarray, fit: NormalFit) -> None:
        """Store the normals of a band, which have padding, at those of its pixels that are inside the mask, [n] bool."""
        count = len(inside)
        self.normal[:, span] = np.where(inside, to_numpy(fit.normal)[:, :count], 0)
        self.residual[span] = np.where(inside, to_numpy(fit.residual)[:count], 0)
        self.status[span] = np.where(inside, to_numpy(fit.status)[:count], int(Status.UNSOLVED))


def half(values: np.ndarray) -> np.ndarray:
    """Return values as float16, those above its largest as that one: what a lamp in the picture makes of albedo is beyond it."""
    return np.minimum(values, HALF_MAX).astype(np.float16)


def mark_not_facing(camera: Camera, solution: Solution) -> None:
    """Set the status NOT_FACING where a normal points away from its line of sight: a visible surface cannot."""
    step = max(1, PIXELS_AT_ONCE // camera.width)
    for first in range(0, camera.height, step):
        rows = min(step, camera.height - first)
        span = slice(first * camera.width, (first + rows) * camera.width)
        x, y, toward = solution.normal[:, span]
        if camera.projection == "perspective":
            right, up = (plane.reshape(-1) for plane in camera.plane_views(first, rows))
            toward = toward - x * right - y * up
        status = solution.status[span]
        status[(status == Status.OK) & (toward <= 0)] = Status.NOT_FACING


def raise_error(solution: Solution, degrees: np.ndarray | float) -> None:
    """Add an independent error, of all normals or [pixels] of each, to their standard error."""
    before = solution.standard_error()
    solution.sigma = np.where(np.isin(solution.status, ESTIMATED), np.hypot(before, degrees), before).astype(np.float16)


def at_all_pixels(mask: np.ndarray, sampled: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return errors that are known at samples at all pixels of a mask, each the root mean square of the nearest.
    `mask`: [rows, cols] bool. `sampled`: [samples] numbers of pixels. `values`: [samples]. Returns [pixels] float32, 0 outside the mask."""
    tree = cKDTree(np.stack(np.divmod(sampled, mask.shape[1]), axis=1))
    found = np.zeros(mask.size, np.float32)
    for first in range(0, mask.size, PIXELS_AT_ONCE):
        inside = first + np.flatnonzero(mask.reshape(-1)[first : first + PIXELS_AT_ONCE])
        _, nearest = tree.query(np.stack(np.divmod(inside, mask.shape[1]), axis=1), k=range(1, min(NEIGHBOURS, len(sampled)) + 1))
        found[inside] = np.sqrt((values**2)[nearest].mean(axis=-1))
    return found


def doubtful_normals(status: np.ndarray) -> str | None:
    """Return the sentence for maps of whose solved pixels many are ambiguous, or none is sure, by the status of their pixels; else None."""
    solved, sure, ambiguous = (int(np.isin(status, kinds).sum()) for kinds in (SOLVED, Status.OK, Status.AMBIGUOUS))
    if solved and not sure:
        return ("no normal is sure to five degrees: all that are solved are ambiguous or not_converged, and the layer sigma says how far "
                "each is off")
    if ambiguous <= MANY_AMBIGUOUS * solved:
        return None
    return (f"{100 * ambiguous / solved:.0f} % of the solved normals are ambiguous, with a standard error above five degrees: the layer "
            "sigma says how far each is off")


def refine_status(solution: Solution, stack: Stack, *, max_sigma: float, least_confidence: float) -> None:
    """Say why pixels have too few lights, and which normals are uncertain, by the status of these pixels.

    Pixels with too few lights become SATURATED where one reading or more saturates, else SHADOWED. Solved pixels with a
    standard error above five degrees become AMBIGUOUS, and those that are less sure than was asked for UNSURE; both keep their values.
    `max_sigma` is in degrees.
    """
    few = np.flatnonzero(solution.status == Status.TOO_FEW_LIGHTS)
    for first in range(0, len(few), PIXELS_AT_ONCE):
        part = few[first : first + PIXELS_AT_ONCE]
        bits = stack.pick_saturated(part)
        saturated = np.unpackbits(bits, axis=0, bitorder="little")[: stack.light_count].sum(axis=0)
        solution.status[part] = np.where(saturated >= 1, int(Status.SATURATED), int(Status.SHADOWED))
    solution.status[(solution.status == Status.OK) & (solution.sigma > AMBIGUOUS_DEGREES)] = Status.AMBIGUOUS
    refuse_unsure(solution.status, solution.standard_error(), solution.confidence, max_sigma=max_sigma, least_confidence=least_confidence)


def suspect_lights(solution: Solution, stack: Stack, lights: Lights) -> list[SuspectLight]:
    """Return the lights, under which the normals were solved, whose direction or strength the images contradict, worst first."""
    solved = np.flatnonzero(solution.status == Status.OK)
    if len(solved) < 2 * LEAST_PIXELS:
        return []
    sigma = solution.sigma[solved]
    sure = solved[sigma <= np.median(sigma)]
    chosen = sure[evenly(len(sure), SUSPECT_PIXELS)]
    values, _ = stack.pick(chosen)
    count = stack.light_count
    weights = channel_weights(lights, GREY_WEIGHTS)
    factor = np.divide(weights * lights.scale[:count, None], lights.irradiance[:count],
                       out=np.zeros((count, 3)), where=lights.irradiance[:count] > 0)
    readings = np.einsum("lc,clp->lp", factor, values[:, :count].astype(np.float64))
    found = suspects(readings, lights.direction[:count].astype(np.float64), solution.normal[:, chosen])
    return [SuspectLight(stack.frames[each.light], round(each.misfit, 3)) for each in found]
