"""Say what a rig holds and what is wrong with it, with a picture of its dome."""

from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels.relight.model.beyond import reach
from service.relight.sheet import BACKGROUND, display, dome_places, write_sheet
from service.requests.rig import RigCheckRequest
from stage.rig.patch import Universe, fixed_channels, patch_faults, slot
from stage.rig.rig import Rig, read_rig
from stage.transforms import fibonacci_sphere

PROBES = 4096
"""The number of directions in which lamps are looked for."""
ONE_SIDED = 0.25
"""A rig without lamps near this part of the sphere is said to leave it dark."""
ONE_PLACE_DEGREES = 0.1
"""The angle between two lamps below which they stand in one direction, as measured places of two lamps never do."""
NEAREST_M, FARTHEST_M = 0.02, 100.0
"""The distances of lamps below and above which places are said to be in another unit."""
SIDE, LAMP = 720, 7
"""The side of the picture of a half of the dome, and the radius of a lamp in it, pixels."""


class RigCheck(NamedTuple):
    """The contents of a rig, and its faults."""

    rig: Rig
    universes: dict[Universe, int]
    """The number of channels in each."""
    primaries: dict[str, int]
    """The number of lamps that have each primary."""
    faults: tuple[str, ...]
    """What keeps lamps from being driven, as `field: what is wrong`."""
    warnings: tuple[str, ...]


def check_rig(request: RigCheckRequest) -> RigCheck:
    """Check a rig and draw its dome where that is asked for.
    Raises ManifestError if the file is wrong; names the field. Raises StorageError if the rig cannot be read or the picture not be
    written."""
    rig = read_rig(request.rig)
    used: set[tuple[Universe, int]] = {(universe, each.channel) for lamp in rig.lights for universe, each in fixed_channels(lamp)}
    for index, primary in rig.emitters:
        if (place := slot(rig.lights[index], primary)) is not None:
            used |= {(place.universe, place.channel + byte) for byte in range(place.bits // 8)}
    channels = Counter(universe for universe, _ in sorted(used, key=lambda each: (each[0].protocol, each[0].number)))
    nearest = np.arccos(np.clip((fibonacci_sphere(PROBES) @ rig.directions.T).max(axis=1), -1, 1))
    uncovered = float((nearest > 2 * reach(rig.directions)).mean())
    warnings = []
    if uncovered > ONE_SIDED:
        warnings.append(f"no lamp stands near {uncovered:.0%} of the sphere: light from there is moved to other lamps or left out "
                        "(relit drive --beyond)")
    warnings += _places(rig)
    if request.picture is not None:
        _draw(rig, request.picture)
    return RigCheck(rig, dict(channels), dict(Counter(primary.name for _, primary in rig.emitters)), tuple(patch_faults(rig)),
                    tuple(warnings))


def _places(rig: Rig) -> list[str]:
    """Say which lamps with the same primaries stand in one direction, and that all stand behind, too far or too near to be lamps."""
    said = []
    directions, subject = rig.directions, np.array(rig.subject_m)
    near = np.arccos(np.clip(directions @ directions.T, -1, 1)) < np.radians(ONE_PLACE_DEGREES)
    names = [{primary.name for primary in lamp.primaries} for lamp in rig.lights]
    pairs = [(one, other) for one, other in zip(*np.nonzero(np.triu(near, 1)), strict=True) if names[one] & names[other]]
    if pairs:
        one, other = pairs[0]
        said.append(f"lights: {rig.lights[one].name} and {rig.lights[other].name} stand in one direction"
                    + (f", and {len(pairs) - 1} more pairs" if len(pairs) > 1 else "") + ": a place that was copied?")
    if (directions[:, 2] < 0).all():
        said.append("lights: all lamps stand behind the subject, which the camera sees unlit: does z point towards the viewer?")
    places = [lamp.position_m for lamp in rig.lights if lamp.position_m is not None]
    distance = float(np.median(np.linalg.norm(np.array(places) - subject, axis=1))) if places else None
    if distance is not None and not NEAREST_M <= distance <= FARTHEST_M:
        doubt = "are the places millimetres?" if distance > FARTHEST_M else "are the places of the scene metres, and not millimetres?"
        said.append(f"lights[].position_m: the lamps stand {distance:.3g} m from the subject (median): {doubt}")
    return said


def _draw(rig: Rig, path: Path) -> None:
    """Write the dome as two discs, its front and its back, each lamp in the colour of its primaries together."""
    colour = np.array([np.sum([primary.irradiance for primary in lamp.primaries], axis=0) for lamp in rig.lights])
    colour = display((0.8 * colour / colour.max(axis=1, keepdims=True))[None].astype(np.float32), rig.color_space)[0]
    down, across = np.mgrid[:SIDE, :SIDE]
    tiles = []
    for name, sign in (("front", 1.0), ("back, seen from the front", -1.0)):
        picture = np.tile(BACKGROUND, (SIDE, SIDE, 1))
        turned = rig.directions * [1.0, 1.0, sign]
        places = dome_places(turned, side=SIDE, reach=SIDE / 2 - 2 * LAMP, widest_degrees=90.0)
        for (row, column), shown, z in zip(places, colour, turned[:, 2], strict=True):
            if z >= 0:
                picture[np.hypot(across - column, down - row) <= LAMP] = shown
        tiles.append((f"{rig.name}: {name}", picture))
    write_sheet(path, [tiles], height=SIDE)
