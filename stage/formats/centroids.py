"""Names of pads: from the attributes of their layer, or from a centroid (pick-and-place) file, a table with the place of each component."""

import csv
import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stage import inputs
from stage.errors import ManifestError
from stage.formats.gerber import Pad

COLUMNS = {
    "name": {"ref", "designator", "refdes", "reference", "component", "name"},
    "x": {"posx", "midx", "x", "centerx", "centrex", "centroidx", "refx", "positionx"},
    "y": {"posy", "midy", "y", "centery", "centrey", "centroidy", "refy", "positiony"},
    "turn": {"rot", "rotation", "angle"},
    "side": {"side", "layer", "tb"},
}
"""Names of the columns, in small letters and without spaces, signs and units, as programs for boards write them."""
UNITS = {"mm": 1e-3, "mil": 2.54e-5, "mils": 2.54e-5, "in": 2.54e-2, "inch": 2.54e-2, "um": 1e-6, "m": 1.0}
ALIKE = 0.05
"""Part of the size of a pad by which two that mirror each other may differ in size and place."""


class Component(NamedTuple):
    """A component of the table."""

    name: str
    place_m: np.ndarray  # [2]
    turn: float
    """Radians, counter-clockwise."""
    bottom: bool
    """Whether it is on the bottom side; False where the table does not say it."""


def read_components(path: Path) -> list[Component]:
    """Read a table with commas, semicolons or tabs, whose first line with a component's name in it names the columns. Its lengths are
    millimetres where neither the name of a column nor the values say another unit. Raises ManifestError; names file and line."""
    try:
        lines = inputs.read_bytes(path).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise ManifestError(f"{path}: is not UTF-8 text") from error
    for number, line in enumerate(lines):
        mark = max(",;\t", key=line.count)
        heads = [_plain(head) for head in next(csv.reader([line], delimiter=mark), [])]
        at = {key: next((column for column, head in enumerate(heads) if head in names), -1) for key, names in COLUMNS.items()}
        if min(at["name"], at["x"], at["y"]) >= 0:
            units = [UNITS[found[1]] if (found := re.search(r"\((\w+)\)", head.lower())) and found[1] in UNITS else UNITS["mm"]
                     for head in next(csv.reader([line], delimiter=mark))]
            return [_component(path, number + 2 + row, values, at, units)
                    for row, values in enumerate(csv.reader(lines[number + 1 :], delimiter=mark)) if any(map(str.strip, values))]
    raise ManifestError(f"{path}: no line names the columns of a component and its place: Designator, Mid X and Mid Y, or Ref, PosX and "
                        "PosY")


def _plain(head: str) -> str:
    return re.sub(r"\(.*\)|[^a-z]", "", head.lower())


def _component(path: Path, number: int, values: list[str], at: dict[str, int], units: list[float]) -> Component:
    try:
        place = np.array([_length(values[at[axis]], units[at[axis]]) for axis in ("x", "y")])
        turn = math.radians(float(values[at["turn"]])) if at["turn"] >= 0 else 0.0
        side = values[at["side"]].strip().lower() if at["side"] >= 0 else ""
        if not (np.isfinite(place).all() and math.isfinite(turn) and values[at["name"]].strip()):
            raise ValueError
        return Component(values[at["name"]].strip(), place, turn, side.startswith("b"))
    except (ValueError, IndexError) as error:
        raise ManifestError(f"{path}: line {number}: must have the name of a component and numbers for its place: {' '.join(values)[:80]}"
                            ) from error


def _length(text: str, unit: float) -> float:
    found = re.fullmatch(r"\s*([-+.\deE]+)\s*([a-z]*)\s*", text)
    if found is None or (found[2] and found[2] not in UNITS):
        raise ValueError
    return float(found[1]) * (UNITS[found[2]] if found[2] else unit)


def component_of(pads: Sequence[Pad], components: Sequence[Component]) -> list[Component | None]:
    """Return the component of each pad: the nearest about which the pad is mirrored onto another like it, or itself, else the nearest; so
    the outer pads of a large package do not go to its small neighbours."""
    if not components:
        return [None] * len(pads)
    centres, sizes = np.array([pad.centre_m for pad in pads]), np.array([pad.size_m for pad in pads])
    places = np.array([component.place_m for component in components])
    out = []
    for centre, size in zip(centres, sizes, strict=True):
        near = np.argsort(np.hypot(*(places - centre).T))
        limit = ALIKE * size.min()
        same = (np.abs(sizes - size) < limit).all(axis=1)
        mirrored = (index for index in near if (np.hypot(*(centres[same] - (2 * places[index] - centre)).T) < limit).any())
        out.append(components[next(mirrored, near[0])])
    return out


def names_of(pads: Sequence[Pad], components: Sequence[Component]) -> list[str]:
    """Return a name for each pad, all unlike: the component and pin that the layer names; else the component and a number, which counts its
    pads from the upper left row by row as it stands at a rotation of 0; else a number."""
    owners = component_of(pads, components)
    bases = [pad.component or (owner.name if owner is not None else None) for pad, owner in zip(pads, owners, strict=True)]
    turns = {component.name: component.turn for component in components}
    names = ["" if pad.pin is None else f"{pad.component}.{pad.pin}" for pad in pads]
    for base in dict.fromkeys(bases):
        members = [index for index, other in enumerate(bases) if other == base and not names[index]]
        turn = turns.get(base or "", 0.0)
        across = {index: float(pads[index].centre_m @ (math.cos(turn), math.sin(turn))) for index in members}
        up = {index: float(pads[index].centre_m @ (-math.sin(turn), math.cos(turn))) for index in members}
        row = max((float(pads[index].size_m.min()) for index in members), default=1.0) / 2
        top = max(up.values(), default=0.0)
        for number, index in enumerate(sorted(members, key=lambda index: (round((top - up[index]) / row), across[index])), start=1):
            names[index] = f"pad {number}" if base is None else f"{base}.{number}"
    counts: Counter[str] = Counter()
    for index, name in enumerate(names):
        counts[name] += 1
        names[index] = name if counts[name] == 1 else f"{name} ({counts[name]})"
    return names
