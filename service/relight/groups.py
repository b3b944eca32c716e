"""The lights of a frame apart from one another: a layer for the environment, and for each light and captured image of the light keys.

Light is additive, so these layers add up to the frame, and each can be made brighter or dimmer in a compositing program.
"""

import re
from collections.abc import Sequence

import numpy as np

from service.errors import RequestError
from service.relight.schedule import ScheduledFrame
from service.requests.light.light_keys import LightKeys

MOST_GROUPS = 32
"""The most layers of lights: a frame of 2048 × 1152 pixels then has half a gigabyte before compression."""
PREFIX = "light_"


def group_names(has_environment: bool, keys: LightKeys | None) -> tuple[str, ...]:
    """Return the name of the layer of each light, MOST_GROUPS at most: letters, digits and underscores, each name once."""
    wanted = ["environment"] if has_environment else []
    if keys is not None:
        wanted += [track.name for track in keys.lights] + [image.rsplit(".", 1)[0] for image in _images(keys)]
    if len(wanted) > MOST_GROUPS:
        raise RequestError(f"--aov lights: the frames have {len(wanted)} lights: there are at most {MOST_GROUPS} layers of lights")
    names: list[str] = []
    for number, text in enumerate(wanted, start=1):
        plain = re.sub(r"[^A-Za-z0-9_]+", "_", text).strip("_") or str(number)
        name = PREFIX + plain
        if name in names:
            name = f"{name}_{number}"
        while name in names:
            name += "_"
        names.append(name)
    return tuple(names)


def in_groups(frame: ScheduledFrame, keys: LightKeys | None) -> tuple[ScheduledFrame, ...]:
    """Return a frame for each light alone, in the order of `group_names`."""
    dark = frame._replace(environment=None, discs=(), captured={})
    alone = [dark._replace(environment=frame.environment)] if frame.environment is not None else []
    alone += [dark._replace(discs=(disc,)) for disc in frame.discs]
    return (*alone, *(dark._replace(captured={image: frame.captured[image]}) for image in (_images(keys) if keys is not None else ())))


def add_up(groups: Sequence[np.ndarray], whole: np.ndarray) -> None:
    """Scale the pictures of lights, each alone [frames, 3, pixels] and changed in place, so that they add up to the whole at every pixel.

    A model of maps that corrects pictures does so less for their sum than for each of them; where they add up to nothing, the first takes
    what the whole holds.
    """
    total = np.sum(groups, axis=0)
    scale = np.divide(whole, total, out=np.zeros_like(whole), where=np.abs(total) > np.finfo(np.float32).tiny)
    for group in groups:
        group *= scale
    groups[0][...] += np.where(scale == 0, whole, 0)


def _images(keys: LightKeys) -> list[str]:
    return list(dict.fromkeys(track.image for track in keys.captured))
