"""The result of one method on one scene whose truth is known: what benchmarks.trust judges."""

from typing import NamedTuple

import numpy as np

from service.depth.depth import DepthResult


class Trial(NamedTuple):
    """Errors and what was said of them, over all pixels that have a truth, solved or not."""

    name: str
    """The method and the scene, in a few words."""
    in_model: bool
    """Whether the scene is one that the method's model describes."""
    error: np.ndarray  # [n] absolute error in `unit`; of a pixel without an estimate it is not looked at
    sigma: np.ndarray  # [n] predicted standard deviation in the same unit
    confidence: np.ndarray  # [n] 0…1
    solved: np.ndarray  # [n] bool, counted as solved
    unit: str
    """`°` for normals, `mm` for depth."""
    note: str = ""
    """The sentence that the result carries, if it has one."""


def range_trial(name: str, in_model: bool, error_m: np.ndarray, result: DepthResult) -> Trial:
    """Return the trial of a depth by time of flight, from the absolute errors [pixels] of its ranges."""
    maps = result.maps
    assert maps.range is not None and maps.sigma is not None and maps.confidence is not None
    along = (maps.depth / np.maximum(maps.range, 1e-9)).ravel()
    return Trial(name, in_model, 1000 * error_m, 1000 * (maps.sigma.ravel() / np.where(along > 0, along, 1)),
                 maps.confidence.ravel().astype(np.float64), maps.mask.ravel(), "mm", " ".join(result.warnings))
