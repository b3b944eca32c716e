"""Choices for reading the pixels of a capture: the part of each image, and the treatment of values below zero."""

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:  # options of the command line are made of these classes, and it starts without NumPy
    import numpy as np


class Crop(NamedTuple):
    """A rectangle of an image in pixels, from its top-left corner."""

    x: int
    """The first column."""
    y: int
    """The first row."""
    width: int
    height: int

    def of(self, image: "np.ndarray") -> "np.ndarray":
        """Return the rectangle of an image, [rows, cols, ...], as a view."""
        return image[self.y : self.y + self.height, self.x : self.x + self.width]

    def is_within(self, resolution: tuple[int, int]) -> bool:
        """Return whether the rectangle lies in an image of this width and height."""
        return self.x + self.width <= resolution[0] and self.y + self.height <= resolution[1]

    def __str__(self) -> str:
        """Return the rectangle as the option gives it."""
        return ",".join(map(str, self))


class PixelChoices(NamedTuple):
    """Choices for reading the pixels of a capture."""

    clip_negative: bool = False
    """True if values that are negative beyond the noise of their image are set to 0; else such an image is refused."""
    crop: Crop | None = None
    """The part of every image that is used; None: all of it."""


AS_RECORDED = PixelChoices()
"""Whole images, in which values are refused that are negative beyond noise."""
