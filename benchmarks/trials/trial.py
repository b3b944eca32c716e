"""The result of one method on one scene whose truth is known: what benchmarks.trust judges."""

from typing import NamedTuple

import numpy as np


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
