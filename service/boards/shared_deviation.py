"""What the deviations of a whole board have in common, as a sensor makes them and no print: heights that are all a part too high, a map
that is larger or smaller as a whole, and edges that are less sharp.

To first order a surface h that is seen with heights g times as high, s times as large and blurred by a Gaussian of variance v deviates by
(g − 1) h − (s − 1) (x h_x + y h_y) + v / 2 · (h_xx + h_yy); what registration leaves deviates by the slopes too. All are fitted at once to
means over small squares, whose noise is less, of the heights in the middle between both maps, so that the noise of neither leans to one
side.
"""

from typing import NamedTuple

import numpy as np

from service.boards.stitching.grid import HeightMap, gradients, local_means, robust_sigma
from stage.spread import TUKEY, between_blocks, tukey_weights

SIDE = 5
"""Side of the squares, pixels."""
MOST_PIXELS = 1_000_000
ROUNDS = 8
LEAST_PIXELS = 1000
CLEAR = 5.0
"""A factor is said that differs from one by so many of its σ."""
TOP = 99
"""Percentile of the deviations that a factor makes: it is said where they are more than the noise of a pixel."""


class Factor(NamedTuple):
    """A number that a whole board deviates by, and its standard deviation."""

    value: float
    sigma: float
    clear: bool
    """Whether it is no chance, and makes deviations above the noise of a pixel."""


class SharedDeviation(NamedTuple):
    """What a board shares; heights and size are 1, and the blur 0, of one that is as its nominal map."""

    heights: Factor
    size: Factor
    blur: Factor
    """Variance of the Gaussian, pixels²; below 0 where the board is sharper than its nominal map."""

    def named(self) -> dict[str, Factor]:
        """Return what each is called in reports."""
        return {"height_factor": self.heights, "size_factor": self.size, "blur_px2": self.blur}

    def sentences(self) -> list[str]:
        """Return a sentence for each that is clear."""
        said = []
        if self.heights.clear:
            said.append(f"the heights of the whole board are {self.heights.value:.4f} times the nominal ones (σ {self.heights.sigma:.1g}): "
                        "check the calibration of depths, here and of the nominal map; what stands high deviates by it")
        if self.size.clear:
            said.append(f"the whole board is {self.size.value:.4f} times as large as its nominal map (σ {self.size.sigma:.1g}): check "
                        "pixel_size_m or the calibration of the camera, here and of the nominal map; edges deviate by it")
        if self.blur.clear:
            how = "less" if self.blur.value > 0 else "more"
            said.append(f"the relief of the whole board is {how} sharp than that of its nominal map, as by a blur of σ "
                        f"{np.sqrt(abs(self.blur.value)):.2g} pixels: check focus and filters of both; edges deviate by it")
        return said


def shared_deviation(deviation: HeightMap, nominal: HeightMap) -> SharedDeviation | None:
    """Fit what the deviations of a whole board, from the nominal heights on the same grid, have in common; None where too little is
    known. The form of the board must have been removed from the deviations."""
    known = deviation.measured
    means = local_means(deviation.height, SIDE)
    surface = local_means(np.where(known, nominal.height + deviation.height / 2, np.nan), SIDE)
    across, down, _ = gradients(surface)
    bent = gradients(np.where(known, across, np.nan))[0] + gradients(np.where(known, down, np.nan))[1]
    rows, cols = np.nonzero(known)
    step = -(-rows.size // MOST_PIXELS)
    rows, cols = rows[::step], cols[::step]
    if rows.size < LEAST_PIXELS:
        return None
    right, under = cols - deviation.grid.cols / 2, rows - deviation.grid.rows / 2
    high, slope_x, slope_y, bend = (values[rows, cols] for values in (surface, across, down, bent))
    columns = np.stack([high, -(right * slope_x + under * slope_y), bend / 2, slope_x, slope_y, under * slope_x - right * slope_y,
                        np.ones(rows.size)])
    scale = np.maximum(np.abs(columns).max(axis=1), 1e-30)
    columns = columns / scale[:, None]
    wanted = means[rows, cols]
    systematic = deviation.systematic[rows, cols]
    sigma = np.hypot(np.sqrt(deviation.variance[rows, cols]) / SIDE, systematic)
    found, weight = np.zeros(len(columns)), 1 / sigma**2
    for _ in range(ROUNDS):
        found = np.linalg.lstsq((columns * weight) @ columns.T, (columns * weight) @ wanted, rcond=1e-12)[0]
        left = wanted - found @ columns
        spread = max(robust_sigma(left / sigma), 1.0)
        weight = tukey_weights(left / sigma, spread) / sigma**2
    inverse = np.linalg.pinv((columns * weight) @ columns.T, rcond=1e-12, hermitian=True)
    kept = np.clip(left / sigma, -TUKEY * spread, TUKEY * spread) / sigma  # what the fit leaves out is no less unlike
    covariance = (between_blocks(inverse, (columns * kept).T, right, under)
              + between_blocks(inverse, (np.abs(columns) * weight * systematic).T, right, under))
    doubt = np.sqrt(np.diag(covariance))
    makes = np.percentile(np.abs(columns[:3] * found[:3, None]), TOP, axis=1)
    clear = (np.abs(found[:3]) > CLEAR * doubt[:3]) & (makes > np.sqrt(np.median(deviation.variance[known])))
    return SharedDeviation(*(Factor(none + float(found[k] / scale[k]), float(doubt[k] / scale[k]), bool(clear[k]))
                             for k, none in enumerate((1.0, 1.0, 0.0))))
