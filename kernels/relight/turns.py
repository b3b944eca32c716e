"""Turns about the axis of a lat-long map that differ by whole samples: the map moves sideways, and what was found about the lights holds.

A spin of 240 frames on a grid of 768 columns, 3.2 columns a frame, has five different turns.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

EQUAL_COLUMNS = 1e-6
"""Turns that differ from whole columns by this part of one, less than a thousandth of a second of arc, differ by whole ones."""


class Turn(NamedTuple):
    """Frames whose maps are the same one but for a move sideways."""

    rotation: np.ndarray  # [3, 3] float64, of the map before it is moved
    frames: tuple[int, ...]
    columns: tuple[int, ...]
    """For each frame: the map turned is the map whose columns are taken from so much further right, then turned by `rotation`."""


def shared_turns(rotations: np.ndarray, columns: int) -> Iterator[Turn]:
    """Group rotations of a lat-long map.

    Args:
        rotations: [frames, 3, 3] float64: turned = rotation @ direction.
        columns: of the grid that the map is cut into.
    """
    groups: dict[int, list[tuple[int, int]]] = {}
    for frame, rotation in enumerate(rotations):
        if not (rotation[1, 1] == 1 and rotation[0, 0] == rotation[2, 2] and rotation[0, 2] == -rotation[2, 0]):
            yield Turn(rotation, (frame,), (0,))
            continue
        turn = np.arctan2(rotation[0, 2], rotation[0, 0]) / (2 * np.pi) * columns
        whole = int(np.floor(turn + EQUAL_COLUMNS))
        groups.setdefault(round((turn - whole) / EQUAL_COLUMNS), []).append((frame, whole))
    for part, members in groups.items():
        # turned by the part of a column, whichever frames there are: weights of a frame do not hang on the frames beside it
        angle = part * EQUAL_COLUMNS / columns * 2 * np.pi
        cosine, sine = np.cos(angle), np.sin(angle)
        rotation = np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])
        yield Turn(rotation, tuple(frame for frame, _ in members), tuple(whole for _, whole in members))
