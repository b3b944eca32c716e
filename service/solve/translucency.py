"""Translucent things, told by the edges of their shadows in red and in blue.

Light that enters a translucent body leaves it beside the place that it fell on. So shading and the edges of shadows are blurred, and
normals come out too flat where the surface bends within the length of that way, and as sure as others: unshadowed readings of a blurred
surface are those of a flatter one. Edges that are soft may as well come from large lamps or the lens. But these blur all colours alike,
while a body scatters farther the light that it absorbs less (Jensen, Marschner, Levoy and Hanrahan, "A Practical Model for Subsurface
Light Transport", SIGGRAPH 2001, table 1), so that its brighter colour has the softer edges. Bounced light lifts the brighter colour in
shadows, but leaves their edges as sharp as they are; sensors with a mosaic of colours resolve red and blue alike.

A body that scatters all colours alike, or much farther than its shadows are wide, is not told from an opaque one that is flatter; nor are
bodies in JPEG files.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from kernels.status import ESTIMATED
from service.light_estimation.lambertian import degrees_between
from service.solve.base.solution import Solution, SolveInput
from service.solve.squares import squares
from stage.capture.point_lights import DistantLights

MOST_LIGHTS = 24
SPANS = 1, 2, 4
"""Pixels between neighbours of the four on a line across an edge."""
MOST_RATIO = 1.25
"""A reading more above the median of its pixel is a highlight."""
LEAST_EDGES = 50
LEAST_STEP = 0.5
"""Least difference over three spans in green: below, the edge may be noise."""
LEAST_CONTRAST = {"darker": 0.4, "brighter": 0.1}
"""Least difference over three spans in the darker and the brighter of red and blue: below, the shadow is narrower than they are."""
LEAST_SHARPER = 1.12
"""Least ratio of sharpness in the darker colour to that in the brighter: 0.96 to 1.04 in opaque scenes, with bounced light and noise too;
1.2 to 1.3 where light scatters twice as far in red as in blue."""
JPEG = ".jpg", ".jpeg"
"""Images whose colours are stored coarser than their brightness, so that edges in the darker colour are up to 1.3 times as sharp."""
BLUR = 0.8
"""Standard deviation of the blur that is undone, in widths of an edge."""


class Translucency(NamedTuple):
    """What the edges of shadows say of a body."""

    sharper: float
    """Ratio of the sharpness of edges in the darker of red and blue to that in the brighter."""
    width_px: float
    """Width of an edge: its height over its slope."""
    degrees: np.ndarray  # [pixels of the image] float32, error that the blur makes of normals; 0 where none is estimated

    @property
    def sentence(self) -> str:
        """What is said of it."""
        return (f"the edges of shadows are {self.width_px:.1f} px wide, and {100 * (self.sharper - 1):.0f} % sharper in the colour that "
                "the object absorbs more, as where light runs below the surface of translucent things, or where the lens blurs the other "
                "colour: normals are blurred as far, and the layer sigma holds what that takes away; matt paint or powder keeps light out")


def find_translucency(given: SolveInput, lights: DistantLights, solution: Solution) -> Translucency | None:
    """Return what shadows say of the way of light below the surface, or None where they show none."""
    if not (lights.irradiance > 0).all() or any(Path(name).suffix.lower() in JPEG for name in given.stack.frames):
        return None
    estimated = np.isin(solution.status, ESTIMATED).reshape(given.mask.shape)
    found = list(squares(given, lights, solution.normal, estimated, most_lights=MOST_LIGHTS))
    red, _, blue = np.sum([square.albedo.mean(axis=(0, 1)) for square in found], axis=0) if found else np.zeros(3)
    darker = 0 if red < blue else 2
    sharper, least, width = 0.0, 0.0, 0.0
    for span in SPANS:
        edges = np.concatenate([_edges(square.ratio, span) for square in found]) if found else np.zeros((0, 4, 3))
        if len(edges) < LEAST_EDGES:
            continue
        inner, outer = edges[:, 2] - edges[:, 1], edges[:, 3] - edges[:, 0]
        passed, whole = inner.mean(axis=0), outer.mean(axis=0)
        if passed.min() <= 0 or whole[darker] < LEAST_CONTRAST["darker"] or whole[2 - darker] < LEAST_CONTRAST["brighter"]:
            continue
        sharp = passed / whole
        error = (inner - sharp * outer).std(axis=0) / passed / np.sqrt(len(edges))  # relative, of a ratio of means
        ratio = float(sharp[darker] / sharp[2 - darker])
        sharper, least = max(sharper, ratio), max(least, ratio * (1 - 2 * float(np.hypot(error[0], error[2]))))
        width = width or span / float(passed.mean())  # by the narrowest span that tells
    if least < LEAST_SHARPER:
        return None
    return Translucency(sharper, width, _lost(solution.normal, estimated, BLUR * width))


def _edges(ratio: np.ndarray, span: int) -> np.ndarray:
    """Return the readings at four pixels on a line across an edge of a shadow, from dark to lit, between the inner of which half of the
    light is passed: [edges, 4, 3]. Green alone finds them: what its noise chooses is no edge of red or of blue."""
    found = [np.zeros((0, 4, 3), np.float32)]
    for axis in (1, 2):
        colours, along = np.moveaxis(ratio, axis, 0), np.moveaxis(ratio[..., 1], axis, 0)
        count = len(along) - 3 * span
        if count <= 0:
            continue
        first, second = along[span:][:count], along[2 * span :][:count]
        for places, step in ((np.nonzero((first < 0.5) & (second >= 0.5)), 1), (np.nonzero((first >= 0.5) & (second < 0.5)), -1)):
            line = np.stack([colours[places[0] + number * span, *places[1:]] for number in range(4)][::step], axis=1)
            green = line[..., 1]
            told = np.isfinite(line).all(axis=(1, 2)) & (green < MOST_RATIO).all(axis=1) & (green[:, 3] - green[:, 0] > LEAST_STEP)
            found.append(line[told])
    return np.concatenate(found)


def _lost(normal: np.ndarray, estimated: np.ndarray, blur_px: float) -> np.ndarray:
    """Return by how many degrees normals, already blurred, turn where they are blurred once more, root mean square nearby: [pixels]."""
    weight = np.maximum(gaussian_filter(estimated.astype(np.float32), blur_px), 1e-6)
    planes = normal.reshape(3, *estimated.shape)
    blurred = np.stack([gaussian_filter(np.where(estimated, plane, 0).astype(np.float32), blur_px) for plane in planes])
    blurred /= np.maximum(np.linalg.norm(blurred, axis=0), 1e-6)
    turned = degrees_between(blurred, planes)
    nearby = np.sqrt(gaussian_filter(np.where(estimated, turned**2, 0).astype(np.float32), blur_px) / weight)
    return np.where(estimated, nearby, 0).reshape(-1)
