"""Sentences about frames: light that the captured images do not hold, from beyond the captured lights or clipped; and the matte."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from service.relight.clipping import Clipping
from stage.colour.radiance import clipping_sentences
from stage.formats import exr
from stage.results.matte import Matte, MatteSource

LEAST_BEYOND = 0.05
"""Least share of a frame's energy from beyond the captured lights that is told: with less, what stands in for it changes the frame by less
than the captured lights themselves leave open (docs/figures.md)."""
LEAST_CLIPPED = 0.005
"""Least share of a channel of a frame from clipped readings that is told."""
LEAST_HARD = 0.005
"""Least share of the border with a hard matte that is told."""
UNKNOWN_MATTE = ("hard: these images, of few lights or of a thin object, do not show how much of a pixel the object covers; a mask image "
                 "with partial values does")
KEPT_BACKGROUND = ("none: the background is lit, so the frames keep it and A is 1; --matte mask cuts the object out, and a mask image with "
                   "partial values does so softly")
PLAIN_BEYOND = ("there the nearest captured lights stand in, so that shading and shadows are wrong and most pixels too bright; --maps "
                "corrects the shading, lights captured there correct both")
GUIDED_BEYOND = ("there the model of the maps is followed, as far as the captured lights confirm it, with the shadows of the nearest "
                 "captured lights; lights captured there show their own shadows")
SHORTER = "add shorter exposures of these lights to the capture (exposure_s)"
PLAIN_CLIPPED = "too dark by an unknown amount; " + SHORTER
GUIDED_CLIPPED = "taken from the model of the maps where it is brighter; " + SHORTER


@dataclass
class FrameFindings:
    """The worst of the frames that were made."""

    guided: bool
    """True if a model of solved maps guides the frames."""
    beyond: float = 0.0
    """Largest share of a frame's energy from beyond the captured lights."""
    beyond_frame: int | None = None
    """Number of that frame; None: of a single picture without a number."""
    beyond_degrees: float = 0.0
    """Least angle of that light from every captured light."""
    clipped: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Shares of red, green and blue of a frame from clipped readings, in the frame where the largest is largest."""
    clipped_frame: int | None = None
    clipped_pixels: float = 0.0
    """Share of the object's pixels that have clipped readings in that capture."""
    doubts: list[str] = field(default_factory=list)
    """Sentences of maps of which nothing tells whether they were solved from the images of their capture."""
    negative: dict[str, int] = field(default_factory=dict)
    """Pixels with a value that was set to 0 because it was negative beyond noise, by the names of the images that were read."""

    def add_beyond(self, numbers: Sequence[int | None], shares: Sequence[float], degrees: float) -> None:
        """Take in the shares of energy of frames that come from more than some degrees beyond the captured lights."""
        for number, share in zip(numbers, shares, strict=True):
            if share > self.beyond:
                self.beyond, self.beyond_frame, self.beyond_degrees = share, number, degrees

    def add_clipped(self, numbers: Sequence[int | None], weights: np.ndarray, clipping: Clipping) -> None:
        """Take in frames [frames, 3, lights padded] by the weights of their stored images."""
        for number, shares in zip(numbers, clipping.share(weights), strict=True):
            if shares.max() > max(self.clipped):
                self.clipped, self.clipped_frame = tuple(float(share) for share in shares), number
                self.clipped_pixels = clipping.pixels

    def add_doubt(self, sentence: str | None) -> None:
        """Take in what is to be said of the maps that guide a capture."""
        if sentence is not None and sentence not in self.doubts:
            self.doubts.append(sentence)

    def add_field(self, sentence: str) -> None:
        """Take in what contradicts a field of the manifest; of a sequence once, because its numbers differ from step to step."""
        name = sentence.split(":", 1)[0]
        if name == "frames" or not any(doubt.startswith(f"{name}:") for doubt in self.doubts):  # frames: those of a step are named
            self.add_doubt(sentence)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Return sentences that say what does not fit, and what to try."""
        found = []
        if self.beyond >= LEAST_BEYOND:
            found.append(f"{_percent(self.beyond)} of the light of {_picture(self.beyond_frame)} comes from directions more than "
                         f"{self.beyond_degrees:.0f} degrees from every captured light: {GUIDED_BEYOND if self.guided else PLAIN_BEYOND}")
        if max(self.clipped) >= LEAST_CLIPPED:
            found.append(clipped_sentence(self.clipped, self.clipped_pixels, _picture(self.clipped_frame),
                                          GUIDED_CLIPPED if self.guided else PLAIN_CLIPPED))
        return (*self.doubts, *found, *clipping_sentences(self.negative))


def clipped_sentence(shares: Sequence[float], pixels: float, picture: str, known: str = PLAIN_CLIPPED) -> str:
    """Return what is to be said of the shares of red, green and blue of a picture from clipped readings, at a share of the pixels."""
    red, green, blue = (_percent(share) for share in shares)
    return (f"{red} of the red, {green} of the green and {blue} of the blue of {picture} is from readings that are clipped in every frame "
            f"of their light, at {_percent(pixels)} of the object's pixels: it is {known}")


def dim_sentences(peak: float) -> list[str]:
    """Return a sentence if the largest value of all frames, `peak`, is 0, or so small that half floats store them in coarse steps, else
    none."""
    if peak == 0:
        return ["every value of the frames is 0: no light that was asked for reaches what the camera sees"]
    if not 0 < peak < exr.HALF_NORMAL:
        return []
    return [f"the brightest value of the frames is {peak:.2g}: below {exr.HALF_NORMAL:.2g} half floats have steps of {exr.HALF_STEP:.2g}, "
            f"in which darker parts are lost; raise --exposure by {round(-math.log2(peak))} to bring it to about 1"]


@dataclass
class MatteFindings:
    """The sources of the mattes of the captures."""

    counts: dict[str, int] = field(default_factory=dict)
    """Number of captures by what the matte is known from."""
    hard: float = 0.0
    """Largest share of the border of an object along which the matte is hard for want of knowledge, 0…1."""

    def add(self, matte: Matte | None) -> None:
        """Take in the matte of a capture."""
        source = "none" if matte is None else str(matte.source)
        self.counts[source] = self.counts.get(source, 0) + 1
        self.hard = max(self.hard, 0.0 if matte is None else matte.hard)

    @property
    def sentence(self) -> str:
        """Return a sentence that names the source of the coverage of partly covered pixels; empty where there is nothing to say."""
        if MatteSource.BACKGROUND in self.counts:
            return KEPT_BACKGROUND
        if self.hard == 1:
            return UNKNOWN_MATTE
        if MatteSource.MASK_IMAGE in self.counts:
            return "soft, from the mask image"
        if MatteSource.IMAGES not in self.counts:
            return ""
        rest = f"; hard along {_percent(self.hard)} of the border, where the background is lit" if self.hard >= LEAST_HARD else ""
        return f"soft, estimated from the captured images along the border of the mask{rest}"


def _picture(number: int | None) -> str:
    return "the picture" if number is None else f"frame {number}"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.995 else "100 %"
