"""F0 of the metals that an object shares, by what all their readings add up to.

A robust fit takes the few readings in which a narrow highlight is brightest for outliers where the surface turns so much within a pixel
that none is as bright as the lobe of one normal would be. It then finds the tail of the lobe, of strength F0 α², and no peak. The sum of
the readings of all lights does not depend on how much a pixel blurs its lobe, nor on a normal that is a little off; pixels of many
normals see the lobe at all its places, however far apart the lights are. So where the sum is surely larger than that of the shared lobe,
F0 grows by their ratio and α shrinks so that the tail stays.

Source: the energy of a lobe is that of its mean over normals (Olano and Baker, "LEAN mapping", I3D 2010).
"""

import numpy as np

from kernels.photometric.material.material import BRIGHTEST_DIELECTRIC, Material, fit_given
from kernels.photometric.model.samples import Samples, host_vectors, to_host
from kernels.photometric.search.hypotheses import LobeShape

LEAST_PIXELS = 16
"""Fewest pixels of a metal whose readings are added up."""
LEAST_RATIO = 1.1
"""Least ratio of the sums that changes a metal: light that other surfaces throw on it is left in the readings to some per cent."""
SURE = 3.0
"""Number of standard errors, from pixel to pixel, by which the ratio must exceed 1."""


def with_whole_energy(samples: Samples, normal: np.ndarray, materials: np.ndarray, single: Material, *,
                      shape: LobeShape) -> np.ndarray | None:
    """Return shared materials, metals with the energy that their readings have; None: they have it already. Waits for the device.

    Args:
        samples: some hundreds of pixels, spread over the object.
        normal: [n, 3] their unit normals.
        materials: [materials, 4] F0 and roughness of shared_materials.choose_materials.
        single: what the pixels are made of, one of these materials each.
    """
    metal = np.flatnonzero(materials[:, :3].max(axis=1) > BRIGHTEST_DIELECTRIC)
    if not len(metal):
        return None
    costs = np.stack([fit_given(samples, normal, material, shape=shape).cost for material in materials])
    nearest, bare = costs.argmin(axis=0), single.specular.max(axis=1) > BRIGHTEST_DIELECTRIC
    readings, toward = (host_vectors(samples, planes) for planes in (samples.colour, samples.toward))
    view, found = to_host(samples, samples.view), materials.copy()
    for number in metal:
        mine = np.flatnonzero((nearest == number) & bare)
        if len(mine) < LEAST_PIXELS:
            continue
        seen = readings[:, mine] >= 0
        lobe, rise = bare_lobe(normal[mine], toward[:, mine], view[mine], float(materials[number, 3]))
        risen, level = ((seen * part).sum(axis=2, dtype=np.float64) for part in (lobe * rise, lobe * (1 - rise)))
        given = (seen * readings[:, mine]).sum(axis=2, dtype=np.float64) - risen
        f0 = np.minimum(given.sum(axis=1) / np.maximum(level.sum(axis=1), 1e-12), 1)
        ratio = f0.sum() / float(materials[number, :3].sum(dtype=np.float64))
        off = (given - f0[:, None] * level).sum(axis=0)
        error = np.sqrt((off**2).sum()) / max(float((materials[number, :3] @ level).sum()), 1e-12)
        if ratio > max(LEAST_RATIO, 1 + SURE * error):
            found[number] = [*f0, materials[number, 3] * ratio**-0.25]
    return None if (found == materials).all() else found


def bare_lobe(normal: np.ndarray, toward: np.ndarray, view: np.ndarray, roughness: float) -> tuple[np.ndarray, np.ndarray]:
    """Return D V n·l and Schlick's rise, [n, lights] each, of pixels with normals and views [n, 3] and lights [3, n, lights]."""
    alpha2 = roughness**4
    nl, nv = np.einsum("nc,cnl->nl", normal, toward), np.maximum((normal * view).sum(axis=1), 1e-3)[:, None]
    hv = np.sqrt(np.maximum(0.5 + 0.5 * np.einsum("nc,cnl->nl", view, toward), 2.5e-7))
    nh = 0.5 * (nl + nv) / hv
    root = [np.sqrt(cosine * cosine * (1 - alpha2) + alpha2) for cosine in (nl, nv)]
    masking = nl * root[1] + nv * root[0]
    lobe = 0.5 / np.pi * alpha2 * nl / ((nh * nh * (alpha2 - 1) + 1) ** 2 * np.maximum(masking, 1e-6))
    return np.where(nl > 0, lobe, 0), np.maximum(1 - hv, 0) ** 5
