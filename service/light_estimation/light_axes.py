"""Which mirroring or turn of the axes of lights makes the normals that were found under them those of one surface, in words."""

from typing import NamedTuple

import numpy as np

from service.light_estimation.axes import Axes, sites, wrong_axes
from service.light_estimation.lambertian import fit_lambertian
from service.light_estimation.object_outline import EDGE, Outline, outline
from stage.capture.camera import Camera

FIT_SIZE = 64
"""Pixels across the small map whose readings are fitted."""
CLEAR, CLEAR_PART = 0.4, 0.8
"""An outline is clear where the mean outward component is above the first number, in the same direction on the second part of it."""
INVERSE = np.diag([-1.0, -1.0, 1.0])
"""The turn by 180 degrees about the view axis."""
INWARD = ("along the outline the normals point inwards: the object is hollow there, or x and y of the lights are both negated (turned by "
          "180° about the view axis); nothing else in the images decides")


class LightAxes(NamedTuple):
    """A fault of the axes of the lights."""

    sentence: str
    matrices: tuple[np.ndarray, ...] = ()
    """[3, 3], what corrects directions and normals: one, or two between which nothing decides; none where nothing is certain."""
    degrees: float | None = None
    """The error of the normals in degrees, where the solved ones are not turned with the lights."""


class Grid(NamedTuple):
    """Every n-th pixel of the box around a mask."""

    pixels: np.ndarray  # [rows, cols] row-major positions in the image
    inside: np.ndarray  # [rows, cols] bool, of the mask

    @classmethod
    def of(cls, mask: np.ndarray, size: int = FIT_SIZE) -> "Grid":
        """Return a grid that is `size` across at most."""
        rows, cols = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
        step = max(1, -(-max(int(np.ptp(rows)), int(np.ptp(cols))) // size))
        margin = step * (3 * size // EDGE + 2)  # of background, so that only the border of the image hides the outline
        row, col = (np.arange(max(lines[0] - margin, 0), min(lines[-1] + margin + 1, count), step)
                    for lines, count in zip((rows, cols), mask.shape, strict=True))
        return cls(row[:, None] * mask.shape[1] + col, mask[np.ix_(row, col)])

    @property
    def chosen(self) -> np.ndarray:
        """Return the positions in the image of the pixels inside, [n]."""
        return self.pixels[self.inside]


class SmallMap(NamedTuple):
    """Normals at the pixels of a grid."""

    normal: np.ndarray  # [3, rows, cols] float32, z towards the viewer of each pixel; 0 outside
    grid: Grid

    @classmethod
    def of(cls, camera: Camera, grid: Grid, normal: np.ndarray) -> "SmallMap":
        """Return the map of normals [3, n] in the camera frame at the chosen pixels."""
        found = np.zeros((3, *grid.inside.shape), np.float32)
        found[:, grid.inside] = toward_viewer(camera, normal, grid.chosen)
        return cls(found, grid)

    @classmethod
    def fitted(cls, camera: Camera, grid: Grid, readings: np.ndarray, usable: np.ndarray, directions: np.ndarray,
               exchange: np.ndarray) -> "SmallMap":
        """Return the map of the Lambertian normals of readings [lights, n] at the chosen pixels, multiplied by a matrix [3, 3]."""
        return cls.of(camera, grid, exchange @ fit_lambertian(readings, usable, directions).normal)

    def wrong_axes(self) -> Axes | None:
        """Return the mirroring or turn after which the normals fit together clearly better, or None."""
        return wrong_axes(np.moveaxis(self.normal.reshape(3, -1)[:, sites(self.grid.inside)], 1, 0))

    @property
    def edge(self) -> Outline:
        """Return how the normals lie along the outline."""
        return outline(self.normal, self.grid.inside)

    def corrections(self, found: Axes, before: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the correction of the axes, after another, whose outline points outwards, of the one that was found and its inverse;
        both where nothing decides."""
        matrix = np.eye(3)
        matrix[:2, :2] = found.matrix
        edge = self._replace(normal=np.einsum("ij,jrc->irc", matrix, self.normal)).edge
        both = (matrix @ before, INVERSE @ matrix @ before)
        return (both[0 if edge.outward > 0 else 1],) if is_clear(edge) else both


def axes_sentence(camera: Camera, grid: Grid, readings: np.ndarray, usable: np.ndarray, directions: np.ndarray) -> str | None:
    """Return a sentence about axes of distant lights [lights, 3] that are mirrored or turned, from readings [lights, n] at the chosen
    pixels, or None."""
    small = SmallMap.fitted(camera, grid, readings, usable, directions, np.eye(3))
    if (found := small.wrong_axes()) is not None:
        return f"frames[].light.direction: {light_axes(small.corrections(found, np.eye(3)), found).sentence}"
    edge = small.edge
    return f"frames[].light.direction: {INWARD}" if edge.outward < 0 and is_clear(edge) else None


def is_clear(edge: Outline) -> bool:
    """Return whether an outline points one way."""
    part = edge.inward_part if edge.outward < 0 else 1 - edge.inward_part
    return abs(edge.outward) >= CLEAR and part >= CLEAR_PART


def toward_viewer(camera: Camera, normal: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return normals [3, n] with the component towards each pixel's viewer as z: their slopes are those of the logarithm of depth."""
    if camera.projection == "orthographic":
        return normal
    row, col = np.divmod(pixels, camera.width)
    right, up = camera.plane_at(col + 0.5, row + 0.5)
    turned = np.stack([normal[0], normal[1], normal[2] - normal[0] * right - normal[1] * up])
    return np.asarray(turned / np.maximum(np.linalg.norm(turned, axis=0), 1e-12))


def light_axes(matrices: tuple[np.ndarray, ...], found: Axes) -> LightAxes:
    """Return the fault that one of several matrices [3, 3] corrects."""
    ways = ", or ".join(describe(matrix) for matrix in matrices)
    kind = "mirrored" if np.linalg.det(matrices[0]) < 0 else "turned"
    odd = kind == "turned" and np.abs(matrices[0] - np.round(matrices[0])).max() > 1e-6  # by no right angle
    shifted = ", that lights which follow each other around the object are not one image off" if odd else ""
    return LightAxes(f"the axes look {kind}: with {ways}, the slopes of the surface are those of one height to {100 * found.left:.0f} %, "
                     f"as declared to {100 * found.misfit:.0f} % (25 % is no order at all); check the axes (x right, y up, z towards the "
                     f"camera){shifted}, and that no image is flipped", matrices)


def describe(matrix: np.ndarray) -> str:
    """Return a correction of directions in words."""
    whole = np.round(matrix)
    if np.abs(matrix - whole).max() > 1e-6:
        turn = np.degrees(np.arctan2(matrix[1, 0], matrix[0, 0]))
        mirrored = "y negated and then all " if np.linalg.det(matrix[:2, :2]) < 0 else "all "
        return f"{mirrored}turned by {turn:.0f}° about the view axis (from x towards y)"
    names = ["xyz"[int(np.argmax(np.abs(row)))] for row in whole]
    signs = [row.sum() < 0 for row in whole]
    if names == list("xyz"):
        negated = [name for name, minus in zip(names, signs, strict=True) if minus]
        if len(negated) == 3:
            return "every direction negated (they seem to point from the light to the surface)"
        return f"{' and '.join(negated)} negated"
    moved = [name for name, own in zip(names, "xyz", strict=True) if name != own]
    if len(moved) == 2 and not any(signs):
        return f"{' and '.join(sorted(moved))} swapped"
    return f"(x, y, z) read as ({', '.join(('-' if minus else '') + name for name, minus in zip(names, signs, strict=True))})"
