"""What the paste of all pads has in common, which no fault of a print explains: too much or too little everywhere, by a wrong stencil,
layer or calibration, and offsets that grow from the middle of the board, by lengths of another scale."""

import numpy as np

from service.boards.stitching.grid import robust_sigma

LEAST_PADS = 8
LEAST_PERCENT = 10.0
"""Volume or area of all pads is said where its median is off by more than this."""
SPREADS = 2.0
"""… and by so many times the spread over the pads."""
CLEAR = 5.0
"""A scale is said that differs from one by so many of its standard errors."""
LEAST_SHIFT_PX = 0.5
"""… and moves the outermost pad by more than this."""


def shared_sentences(volume: np.ndarray, area: np.ndarray, places_m: np.ndarray, offsets_m: np.ndarray, *, pixel_m: float) -> list[str]:
    """Return a sentence for each thing that the pads share.
    `volume`, `area`: [pads] in % of their openings. `places_m`, `offsets_m`: [pads, 2] middles of pads, and how far their paste lies from
    them."""
    if len(volume) < LEAST_PADS:
        return []
    said = []
    name, values, check = ("volume", volume, "check --stencil-m, the calibration of depths, and whether copper under the paste stands "
                           "above what is around it")
    if abs(100 * np.median(volume / area) - 100) < LEAST_PERCENT:
        name, values, check = "area", area, "check that the layer is that of the stencil, not of the mask or the copper"
    middle, spread = float(np.median(values)), robust_sigma(values)
    if abs(middle - 100) > max(LEAST_PERCENT, SPREADS * spread):
        said.append(f"the paste of all pads has {middle:.0f} % of the {name} of their openings (spread {spread:.1g} %): {check}")
    away, moved = (values - np.median(values, axis=0) for values in (places_m, offsets_m))
    rows, wanted = away.ravel(), moved.ravel()
    factor = float(rows @ wanted / (rows @ rows))
    sigma = robust_sigma(wanted - factor * rows) / float(np.sqrt(rows @ rows))
    if abs(factor) > CLEAR * sigma and abs(factor) * float(np.hypot(*away.T).max()) > LEAST_SHIFT_PX * pixel_m:
        said.append(f"the paste lies {1 + factor:.4f} times as far apart as the openings (σ {sigma:.1g}): check pixel_size_m or the "
                    "calibration of the camera, and the unit and scale of the layer; offsets grow with it")
    return said
