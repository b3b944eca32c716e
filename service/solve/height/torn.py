"""Fragments of a surface that meet along their outlines and yet stand apart, as the shadows in the images say.

Normals join two fragments where one shift makes them meet along most of their outlines (kernels/surface/parts.py). A flat ring before a
body may do so though it stands far before it. Each fragment that was joined to a larger one is moved alone along the line of sight: where
the shadows place it elsewhere, beyond doubt, the surface is cut around it and integrated again.
"""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from kernels.device import to_numpy
from kernels.surface.integrate import Integration
from kernels.surface.offsets import Offset
from service.solve.height.part_scene import LEAST_SHARE, MOST_PARTS, PartScene

SWEEPS = 2
"""Times that every fragment is moved, each against the others where these lie now."""
APART_SIGMAS = 3.0
"""Distance, in its σ, at which shadows place a fragment from where it was joined, from which on it is cut off."""


class Again(Protocol):
    """Integrates the normals again."""

    def __call__(self, *, cuts: tuple[np.ndarray, np.ndarray]) -> Integration | None:
        """Break the surface along some edges to the right, and some down, too, [rows, cols] bool each."""


def tear(surface: Integration, height: np.ndarray, scene_of: Callable[[], PartScene], again: Again) -> tuple[Integration, np.ndarray]:
    """Return a surface with the fragments apart that shadows part, and its height [rows, cols] float32.
    `height`: [rows, cols] float32, that of the surface. `scene_of`: returns the scene in which its parts move."""
    fragment, part_of = surface.fragment, surface.part_of
    assert fragment is not None and part_of is not None
    size = np.bincount(fragment[fragment >= 0], minlength=len(part_of))
    largest_first = np.argsort(-size, kind="stable")
    host = np.zeros(len(part_of), dtype=int)
    host[part_of[largest_first[::-1]]] = largest_first[::-1]
    judged = [int(number) for number in largest_first if host[part_of[number]] != number and size[number] >= LEAST_SHARE * size.sum()]
    if not judged:
        return surface, height
    scene = scene_of()
    scene.show(height, fragment)
    apart: dict[int, Offset] = {}
    main = int(np.argmax(np.bincount(part_of, weights=size)))
    settled: set[int] = set()  # judged since anything else moved: they would be placed as they were
    for number in SWEEPS * judged[:MOST_PARTS]:
        if number in settled:
            continue
        others = np.flatnonzero((part_of == main) | (part_of == part_of[number]))
        step = scene.step_of(number, against=[int(other) for other in others if other != number])
        before = apart.pop(number).offset if number in apart else 0.0
        if scene.is_known(step.low, step.high) and abs(before + step.offset) > APART_SIGMAS * step.sigma:
            apart[number] = step._replace(offset=before + step.offset)
        moved = (apart[number].offset if number in apart else 0.0) - before
        scene.move(number, moved)
        settled = {number} if moved else {*settled, number}
    if not apart:
        return surface, height
    out = np.isin(fragment, list(apart))
    cuts = np.zeros(fragment.shape, dtype=bool), np.zeros(fragment.shape, dtype=bool)
    cuts[0][:, :-1] = out[:, 1:] != out[:, :-1]
    cuts[1][:-1] = out[1:] != out[:-1]
    found = again(cuts=cuts)
    assert found is not None
    part, placed = found.part, to_numpy(found.height).copy()
    assert part is not None
    for each in np.unique(part[np.isin(fragment, np.flatnonzero(np.isin(part_of, part_of[list(apart)])))]):
        mine = part == each
        number = int(np.bincount(fragment[mine]).argmax())
        behind = fragment == host[part_of[number]]
        # what was joined through a fragment that is apart stays where it was
        before, after = (scene.level(z, mine) - scene.level(z, behind) for z in (height, placed))
        scene.shift(placed, mine, before - after + (apart[number].offset if number in apart else 0.0))
    return found, placed
