"""How a render differs from the truth: every pixel of the mask counts."""

from typing import NamedTuple

import numpy as np

METAL_SHARE = 0.5
"""Pixels whose material is metal for more than this part count as metal."""


class Comparison(NamedTuple):
    """The figures of one render."""

    scale: float
    """A factor on the whole render, chosen so that its squared error is least. All clients and the truth have the same units, so 1 is
    right."""
    rmse: float
    """Root of the mean squared error after that factor, divided by the mean of the truth."""
    mean_error: float
    """Mean absolute error after that factor, divided by the mean of the truth."""
    metal: float
    """Sum over metal pixels divided by that of the truth, after that factor; NaN without metal."""
    dielectric: float
    """The same of the other pixels."""


def compare(picture: np.ndarray, truth: np.ndarray, mask: np.ndarray, metal: np.ndarray | None = None, *,
            scaled: bool = True) -> Comparison:
    """Return how a picture differs from the truth.

    Args:
        picture: [rows, cols, 3 or 4] linear; alpha is not read, colours are premultiplied.
        truth: [rows, cols, 3] linear.
        mask: [rows, cols] bool, the pixels that count.
        metal: [rows, cols] share of metal in the material, 0…1; None: nothing is metal.
        scaled: False compares without a factor.
    """
    ours, true = picture[..., :3].astype(np.float64), truth.astype(np.float64)
    a, b = ours[mask], true[mask]
    scale = float((a * b).sum() / (a * a).sum()) if scaled else 1.0
    difference, mean = scale * a - b, b.mean()
    is_metal = np.zeros(mask.shape, bool) if metal is None else metal > METAL_SHARE

    def energy(where: np.ndarray) -> float:
        return float(scale * ours[where].sum() / true[where].sum()) if where.any() else float("nan")

    return Comparison(scale, float(np.sqrt((difference**2).mean()) / mean), float(np.abs(difference).mean() / mean),
                      energy(mask & is_metal), energy(mask & ~is_metal))
