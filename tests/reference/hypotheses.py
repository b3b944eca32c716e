"""The cost of a candidate normal, vectorised over pixels in plain NumPy, from the description in docs/svbrdf.md: a non-negative
mixture of lobes fitted by re-weighted coordinate descent, Cauchy cost, cast shadows at a fixed charge. Imports nothing of ours but the
float64 reflectance model beside it."""

import numpy as np

from tests.reference import microfacet

ALPHAS = (0.08, 0.15, 0.25, 0.4, 0.6)


def lobes(normal, lights, view, *, rough=None, slope=0.0):
    """[n, L, 6]: the diffuse lobe (times π) and the GGX lobes at F0 = 0.04, scaled by 0.1 / 0.04, of each pixel's candidate."""
    n, light, v = normal[:, None], lights[None], view[:, None]
    columns = [np.pi * microfacet.diffuse(n, light, v, rough, slope)]
    columns += [microfacet.specular(n, light, v, alpha, 0.04) * 2.5 for alpha in ALPHAS]
    return np.stack(columns, axis=-1)


def cost(readings, normal, lights, view, *, rough=None, slope=0.0, floor=0.1, relative=0.02, charge=1.0, depth=0.3, rounds=5,
         sweeps=12):
    """Mean over the lights of log(1 + r²/σ²), a cast shadow at `charge`.

    Args:
        readings: [n, L] relative to the pixel's level; below 0 where there is no reading.
        normal: [n, 3] unit.
        lights: [L, 3] unit.
        view: [n, 3] unit.

    Returns:
        [n] costs.
    """
    table = lobes(normal, lights, view, rough=rough, slope=slope)
    given = readings >= 0
    sigma = floor + relative * np.maximum(readings, 0)
    mixture = np.zeros((len(readings), table.shape[-1]))
    for turn in range(rounds + 1):
        predicted = np.einsum("nlk,nk->nl", table, mixture)
        squared = np.zeros_like(readings) if turn == 0 else ((readings - predicted) / sigma) ** 2
        shadow = (readings < depth * predicted) & (squared > np.expm1(charge))
        if turn == rounds:
            return (given * np.where(shadow, charge, np.log1p(squared))).sum(axis=1) / readings.shape[1]
        weight = given * np.where(shadow | (readings <= 0), 0.1, 1.0) / sigma**2 / (1 + squared)
        gram = np.einsum("nl,nlj,nlk->njk", weight, table, table)
        right = np.einsum("nl,nlk->nk", weight * readings, table)
        for _ in range(sweeps):
            for k in range(table.shape[-1]):
                rest = right[:, k] - np.einsum("nk,nk->n", gram[:, k], mixture)
                mixture[:, k] = np.maximum(mixture[:, k] + rest / (gram[:, k, k] + 1e-8), 0)
    raise AssertionError("unreachable")
