"""What every solver of a whole image gives back."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from kernels.photometric.lambert import NormalFit
from kernels.status import Status

READING_BYTES = 4
"""A grey reading, per light and pixel, beside the stack's band."""

NEAR_BYTES = READING_BYTES + 16
"""The same where lights are near: with a direction and a falloff."""


@dataclass
class Solution:
    """What was found at every pixel of the image; only pixels with a status of kernels.status.SOLVED have values."""

    normal: np.ndarray  # [3, pixels] float32
    albedo: np.ndarray  # [3, pixels] float16
    confidence: np.ndarray  # [pixels] float16
    residual: np.ndarray  # [pixels] float16
    status: np.ndarray  # [pixels] uint8
    specular: np.ndarray | None = None  # [3, pixels] float16, F0
    roughness: np.ndarray | None = None  # [pixels] float16
    specular_normal: np.ndarray | None = None  # [3, pixels] float32
    regime: np.ndarray | None = None  # [pixels] uint8, codes of kernels.photometric.sampling.Regime
    facts: dict[str, Any] = field(default_factory=dict)
    """For the report."""

    @classmethod
    def empty(cls, pixels: int) -> "Solution":
        """Nothing solved yet."""
        return cls(np.zeros((3, pixels), np.float32), np.zeros((3, pixels), np.float16), np.zeros(pixels, np.float16),
                   np.zeros(pixels, np.float16), np.zeros(pixels, np.uint8))

    def place(self, here: slice, kept: np.ndarray, fit: NormalFit) -> None:
        """Take over the normals of a band.

        Args:
            here: its pixels.
            kept: [n] bool, which of them are inside the mask.
            fit: of the band, padded.
        """
        count = len(kept)
        self.normal[:, here] = np.where(kept, fit.normal.numpy()[:, :count], 0)
        self.confidence[here] = np.where(kept, fit.confidence.numpy()[:count], 0)
        self.residual[here] = np.where(kept, fit.residual.numpy()[:count], 0)
        self.status[here] = np.where(kept, fit.status.numpy()[:count], int(Status.UNSOLVED))
