"""How far edges of stripes may lie from where they seem to be, by how often they pass between two pixels unseen.

Pixels of a camera see about as much of a surface as they are apart, and an edge changes the light of one of them at least. Images that are
rendered or shrunk without a filter show points of the surface: an edge lies anywhere between two of them.
"""

import numpy as np

from kernels.structured.edges import WHOLE, edge_error_of
from kernels.structured.pattern_frames import NoiseModel
from service.depth.patterns.readings import line_readings
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Collected
from stage.stack.planes import Planes

PAIRS = 32
"""Number of pairs of neighbouring image rows whose edges are looked at, evenly spread."""
LIT_SIGMAS = 20.0
"""Least difference of a bit and its inverse, in deviations of a reading, of pixels whose edges count."""
FEW_EDGES = 16
"""Number of edges that count as seen by pixels as wide as they are apart, so that few edges tell nothing."""


def measured_edge_error(planes: Planes, mask: np.ndarray, collected: Collected, noise: NoiseModel) -> float:
    """Return the RMS error in camera pixels of an edge of a Gray code with inverses that is found by linear interpolation."""
    seen, whole = FEW_EDGES, FEW_EDGES * (1 - WHOLE)
    first = np.unique(np.linspace(0, len(mask) - 1, PAIRS + 2).astype(int)[1:-1] // 2 * 2)
    first = first[first + 1 < len(mask)]
    rows = np.stack([first, first + 1], axis=1).ravel()
    grey, clipped = line_readings(planes, rows, 1)
    inside = mask[rows] if clipped is None else mask[rows] & ~clipped
    for code in collected.codes:
        if not isinstance(code, BinaryCode) or code.name != "gray" or code.inverses is None:
            continue
        bits, inverses = grey[list(code.frames)], grey[list(code.inverses)]
        apart, clearest = bits - inverses, np.abs(bits - inverses).max(axis=0)
        deviation = np.sqrt(2 * noise.read**2 + noise.gain * np.maximum(bits + inverses, 0).max(axis=0))
        known = inside & (clearest > LIT_SIGMAS * deviation)
        for side, other in ((np.s_[..., :-1], np.s_[..., 1:]), (np.s_[..., ::2, :], np.s_[..., 1::2, :])):  # along rows, and across pairs
            changes = (apart[side] > 0) != (apart[other] > 0)
            edge = (changes.sum(axis=0) == 1) & known[side] & known[other]
            full = np.abs(apart) >= WHOLE * clearest
            seen += int(edge.sum())
            whole += int((changes & full[side] & full[other]).any(axis=0)[edge].sum())
    return edge_error_of(whole / seen)
