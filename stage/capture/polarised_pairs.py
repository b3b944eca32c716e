"""Pairs of a cross- and a parallel-polarised image of each light, and what their sums are.

Diffuse reflection D loses the polarisation of the light, a highlight S keeps it (of a metal all light is highlight). Behind polarisers that
pass the part ε of what they should block, a cross frame holds C = D/2 + εS and a parallel one P = D/2 + (1 - ε)S. So

    S = (P - C) / (1 - 2ε),    D = 2 ((1 - ε) C - εP) / (1 - 2ε),    D + S = C + P whatever ε is.

Noise of D and S is that of C and P times these factors, and values below zero are noise.

Source: Ma et al., "Rapid acquisition of specular and diffuse normal maps from polarized spherical gradient illumination", EGSR 2007,
    section 3; Debevec et al., "Acquiring the reflectance field of a human face", SIGGRAPH 2000, section 4.1; Ghosh, Chen, Peers, Wilson and
    Debevec, "Circularly polarized spherical illumination reflectometry", ACM Trans. Graphics 29(6), 2010.
"""

from enum import Enum

import numpy as np

from stage.capture.capture import Capture
from stage.capture.light import DistantLight, PointLight
from stage.capture.manifest import FILE_NAME
from stage.errors import ManifestError

SAME_PLACE = 1e-4
"""Lights closer together than this part of their distance, 0.006 degrees, are one light: as close as the weights of images take them for
one."""


class Component(Enum):
    """A part of the reflected light, as a sum of the two images of a pair."""

    WHOLE = "whole"
    DIFFUSE = "diffuse"
    SPECULAR = "specular"
    CROSS = "cross"
    PARALLEL = "parallel"

    def gains(self, leak: float) -> tuple[float, float]:
        """Return the factors of the cross and of the parallel image; `leak`: ε, from 0 to below one half."""
        apart = 1 - 2 * leak
        return {Component.WHOLE: (1.0, 1.0), Component.SPECULAR: (-1 / apart, 1 / apart),
                Component.DIFFUSE: (2 * (1 - leak) / apart, -2 * leak / apart),
                Component.CROSS: (1.0, 0.0), Component.PARALLEL: (0.0, 1.0)}[self]


def first_in_place(place: np.ndarray) -> np.ndarray:
    """Return [lights] the first light in the place of each; `place`: [lights, 3] unit directions, or [lights, 4] of `PlacedLights`."""
    distance = np.linalg.norm(place[:, None] - place, axis=2)
    return np.asarray((distance < SAME_PLACE * np.linalg.norm(place[:, :3], axis=1)).argmax(axis=1))


def check_pairs(capture: Capture, place: np.ndarray) -> None:
    """Check that every light has both images of a polarised pair, or that none is polarised; `place` as in `first_in_place`."""
    if not capture.is_polarised:
        return
    where = capture.folder / FILE_NAME
    lit = [(index, frame.light) for index, frame in enumerate(capture.manifest.frames)
           if isinstance(frame.light, DistantLight | PointLight)]
    kinds = np.array([light.polarization for _, light in lit])
    plain = np.flatnonzero(kinds == "none")
    if len(plain):
        raise ManifestError(f"{where}: frames[{lit[plain[0]][0]}].light.polarization: is none where other lights are polarised: take a "
                            "cross and a parallel image of every light")
    owner = first_in_place(place)
    alone = [row for row in range(len(lit)) if len(set(kinds[owner == owner[row]])) < 2]
    if alone:
        index, light = lit[alone[0]]
        missing = "parallel" if light.polarization == "cross" else "cross"
        more = f" (and {len(alone) - 1} frames more lack theirs)" if len(alone) > 1 else ""
        raise ManifestError(f"{where}: frames[{index}].light.polarization: is {light.polarization}, and no {missing} frame has the same "
                            f"light{more}: a pair has both")
    for index, light in lit:
        if 0 in (light.irradiance if isinstance(light, DistantLight) else light.intensity):
            raise ManifestError(f"{where}: frames[{index}].light: has no light in one channel: polarised pairs need all three")
