"""Roughness and F0 that the pixels of an object agree on: each by its own evidence and its neighbours'.

Materials are fitted pixel by pixel, and speckle where a pixel alone cannot tell them. Neighbours of the same colour and part mostly have
the same material, so that the maps of least total variation about what pixels say replace it (`total_variation`): pixels whose normals are
sure keep what they say, and borders stay where colours differ or where both sides are sure.
"""

import numpy as np

from kernels.photometric.material.material import BRIGHTEST_DIELECTRIC
from kernels.photometric.material.total_variation import STEPS, between, least_variation
from kernels.status import ESTIMATED
from service.reporting.progress import Progress, Timings
from service.solve.base.solution import Solution

STRENGTH = 0.5
"""Weight of a link between neighbours of one colour, over the trust in a pixel."""
TRUST_FALLS = -3
"""Power of 1 + σ/1° with which the trust in a pixel falls: -2 leaves more speckle, -4 finds the same."""
METAL_TRUST = 2.0
"""Factor on the trust in a metal, which shows its lobe under every light and nothing beside it."""
USUAL_TRUST = 0.1
"""Mean trust in the pixels of the owl sample. Trust counts over the geometric mean of this and its mean over the object: over the latter
alone, objects whose pixels are all sure lose small patches, and over this alone those whose pixels are all unsure keep their speckle."""
COLOUR = 0.3
"""Difference of the logarithms of two colours at which a link has exp(-1/2) of its weight."""
DARKEST = 0.02
"""Albedo below which colours count as black: differences there are noise."""
UNSURE_WIDTH = 0.25
"""Least width α of the lobe of a dielectric over the standard error of its normal, in radians: a narrower lobe shines somewhere else, and
under a light beside it the pixel would flare up. Metals, whose standard errors are several times too large, keep theirs."""


def agree_on_materials(solution: Solution, sigma: np.ndarray, shape: tuple[int, int], device: str,
                       progress: Progress | None = None) -> None:
    """Replace roughness and F0 of a solution by those that neighbouring pixels agree on, and widen lobes of dielectrics that are narrower
    than their normals are sure; pixels with two materials keep theirs.
    `sigma`: [pixels] standard error of the normals as each pixel's own readings show it, degrees. `shape`: rows and columns of the
    image. `device`: as Warp spells it."""
    if solution.roughness is None or solution.specular is None:
        return
    known = np.isin(solution.status, ESTIMATED).reshape(shape)
    if not known.any():
        return
    box = tuple(slice(int(at.min()), int(at.max()) + 1) for at in np.nonzero(known))

    def image(values: np.ndarray) -> np.ndarray:
        return values.reshape(-1, *shape)[:, *box].astype(np.float32)

    if solution.blurred is not None:
        known.flat[solution.blurred] = False  # their lobes are wider than those of their material
    known = known[box]
    if solution.abundance is not None:
        known &= image(solution.abundance)[0] == 0
    trust = np.where(known, (1 + image(sigma)[0]) ** TRUST_FALLS, 0)
    trust /= np.sqrt(USUAL_TRUST * max(trust.sum() / max(known.sum(), 1), 1e-9))
    specular = image(solution.specular)
    metal = specular.max(axis=0) > BRIGHTEST_DIELECTRIC
    trust *= np.where(metal, METAL_TRUST, 1)
    colour = np.log(np.maximum(image(solution.albedo) + metal * specular, DARKEST))
    part = None if solution.integration is None else solution.integration.part
    parts = np.zeros(known.shape) if part is None else part[box]
    links = []
    for step in STEPS:
        one, other = between(step)
        unlike = ((colour[:, *one] - colour[:, *other]) ** 2).mean(axis=0) / COLOUR**2
        together = known[one] & known[other] & (parts[one] == parts[other])
        links.append((STRENGTH / np.hypot(*step) * together * np.exp(-0.5 * unlike)).astype(np.float32))
    neutral = (specular == specular[:1]).all()  # no coloured metal: one plane stands for three
    timings = Timings(progress)
    timings.stage("materials", 100)
    found = least_variation(np.concatenate([image(solution.roughness), specular[:1] if neutral else specular]), trust, links, device=device,
                            progress=timings.advance_percent)
    timings.advance(100)
    lobe = (found[0] > 0) & (found[1:].max(axis=0) <= BRIGHTEST_DIELECTRIC)
    found[0] = np.where(lobe, np.maximum(found[0], np.sqrt(UNSURE_WIDTH * np.radians(image(sigma)[0]))), found[0])
    for target, planes in ((solution.roughness, found[:1]), (solution.specular, found[1:])):
        target.reshape(-1, *shape)[:, *box] = np.where(known, planes, target.reshape(-1, *shape)[:, *box])
