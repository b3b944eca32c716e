"""A model of the surface under the light of frames, and what its difference from the captured images adds to them."""

from typing import NamedTuple

import numpy as np

from kernels.relight.beyond import followed


class LitModel(NamedTuple):
    """The model of some pixels under the light of one frame or of several ([frames, 3, n] in place of [3, n])."""

    matt: np.ndarray  # [3, n] diffuse part under the light between the captured lights
    gloss: np.ndarray  # [3, n] specular part under it
    whole: np.ndarray  # [3, n] what the weighted sum of images contains for it, with gloss as bright as the images show it
    ratio: np.ndarray  # [3, n] of image to model that the gloss has there (kernels.relight.gloss_ratio)
    added: "np.ndarray | None"  # [2, 3, n] diffuse and specular part of the captured images that the frame adds
    beyond: "LitBeyond | None"
    """Under the light from beyond the captured lights; None: there is none."""


class LitBeyond(NamedTuple):
    """The model under the light from beyond the captured lights."""

    whole: np.ndarray  # [3, n]
    gloss: np.ndarray  # [3, n] the specular part of it
    captured: np.ndarray  # [3, n] under what stands in for it in the weighted sum of images


def correction(model: LitModel, plain: np.ndarray, trust: np.ndarray, trust_beyond: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return what is added to frames, and the model's specular part of their light.

    Args:
        model: under their light.
        plain: [3, n] or [frames, 3, n] sums of captured images.
        trust: [n] β between the captured lights.
        trust_beyond: [n] β beyond them; not None where the model has such light.
    """
    mirror = model.gloss * model.ratio
    change = trust * (model.matt + mirror - model.whole)
    added = None if model.added is None else model.added.sum(axis=-3)
    if model.beyond is not None and trust_beyond is not None:
        beyond = model.beyond
        whole = beyond.captured + np.maximum(model.whole, 0)
        change = change + trust_beyond * followed(beyond.whole - beyond.captured, plain, whole if added is None else whole + added)
        mirror = mirror + beyond.gloss
    if model.added is not None:
        mirror = mirror + model.added[..., 1, :, :]
    return change, mirror
