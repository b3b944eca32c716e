"""Make a rig of the lamps that lit a capture, or of a table of lamps."""

from collections.abc import Iterator, Sequence
from itertools import repeat
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from service.errors import RequestError
from service.requests.play import Protocol
from service.requests.rig import PatchOptions, Primaries, RigFromCaptureRequest, RigFromCsvRequest
from stage.capture.capture import Capture
from stage.capture.light import PointLight
from stage.capture.lighting import lights_from_centre
from stage.capture.point_lights import place_lights
from stage.colour.colour_spaces import linear_space
from stage.errors import ManifestError
from stage.formats.csv_table import read_table
from stage.importers.light_table import check_angles
from stage.model import Strict
from stage.records import describe
from stage.rig.rig import CHANNELS, RIG_SCHEMA, UNIVERSES, Address, Lamp, Primary, Rig, write_rig

RGB = ("red", "green", "blue")
COLOURS = {"red": (1.0, 0.0, 0.0), "green": (0.0, 1.0, 0.0), "blue": (0.0, 0.0, 1.0), "white": (1.0, 1.0, 1.0), "amber": (1.0, 0.5, 0.0)}
"""The nominal colours of primaries by name; `relit calibrate rig` measures those of a stage."""
Part = TypeVar("Part", bound=Strict)


def rig_from_capture(request: RigFromCaptureRequest) -> Rig:
    """Write the rig of the lamps that lit a capture and return it.
    Raises RequestError for addresses beyond the protocol's. Raises StageError for bad input; it names file and field. Raises StorageError
    if the file cannot be written."""
    capture = Capture.open(request.capture)
    lights = lights_from_centre(capture)
    placed = place_lights(capture) if capture.lit_by(PointLight) else None
    white = request.primaries is Primaries.WHITE
    names = ("white",) if white else RGB
    patch = addresses(request, names)
    lamps, used = [], set[str]()
    for index, frame in enumerate(capture.sources()):
        name = Path(frame.image).stem
        name = f"{name}-{index + 1}" if name in used else name
        used.add(name)
        strength = lights.irradiance[index]
        if white:
            primaries = [Primary(name="white", irradiance=tuple(strength))]
        else:
            dark = [colour for colour, value in zip(RGB, strength, strict=True) if value <= 0]
            if dark:
                raise RequestError(f"{request.capture}: the light of {frame.image} has no {dark[0]}: give --primaries white")
            primaries = [Primary(name=colour, irradiance=tuple(row)) for colour, row in zip(RGB, np.diag(strength), strict=True)]
        place = {"type": "point", "position_m": frame.light.position_m} if isinstance(frame.light, PointLight) else {
            "type": "distant", "direction": tuple(lights.direction[index])}
        lamps.append(checked(Lamp, {"name": name, **place, "primaries": tuple(primaries), "bits": request.bits, "address": next(patch)},
                             f"{request.capture}: {frame.image}"))
    manifest = capture.manifest
    rig = checked(Rig, {"schema": RIG_SCHEMA, "name": manifest.name, "color_space": linear_space(manifest.color_space),
                        "subject_m": (0.0, 0.0, 0.0) if placed is None else tuple(placed.centre), "camera": manifest.camera,
                        "lights": tuple(lamps)}, str(request.out))
    write_rig(rig, request.out)
    return rig


def rig_from_csv(request: RigFromCsvRequest) -> Rig:
    """Write the rig of a table of lamps and return it.
    Raises RequestError for addresses beyond the protocol's, or a primary of no known colour. Raises ManifestError if the table is wrong;
    names the line and the column. Raises StorageError if the table cannot be read, or the rig not be written."""
    unknown = [name for name in request.primaries if name not in COLOURS]
    if unknown or len(set(request.primaries)) < len(request.primaries):
        raise RequestError(f"--primaries {','.join(request.primaries)}: give different ones of {', '.join(COLOURS)}")
    rows = read_table(request.table, ("name", "x", "y", "z"))
    heads = rows.fieldnames or ()
    if ("universe" in heads) != ("channel" in heads):
        raise ManifestError(f"{request.table}: has one of the columns universe and channel: give both or neither")
    patched = "universe" in heads
    patch = repeat(None) if patched else addresses(request, request.primaries)
    lamps, places = [], []
    for row, address in zip(rows, patch, strict=False):
        where = f"{request.table}: line {rows.line_num}"

        def number(column: str, row: dict[str, str] = row, where: str = where) -> float:
            try:
                return float(row[column])
            except (TypeError, ValueError) as error:
                raise ManifestError(f"{where}: {column}: is {row[column]}: must be a number") from error

        place = number("x"), number("y"), number("z")
        strength = number("irradiance") if "irradiance" in heads else request.irradiance
        if patched:
            universe, channel = number("universe"), number("channel")
            if int(universe) != universe or int(channel) != channel:
                raise ManifestError(f"{where}: universe and channel are {row['universe']} and {row['channel']}: give whole numbers")
            channel = int(channel)
            given = {name: channel + index * request.bits // 8 for index, name in enumerate(request.primaries)}
            entry: object = {"protocol": request.protocol.value, "universe": int(universe), "channels": given,
                             "host": request.host}
        else:
            entry = address
        data = {"name": row["name"], "type": "point" if request.places else "distant", "bits": request.bits, "address": entry,
                "position_m" if request.places else "direction": place,
                "primaries": [{"name": name, "irradiance": tuple(strength * part for part in COLOURS[name])} for name in request.primaries]}
        lamps.append(checked(Lamp, data, where))
        places.append(place)
    check_angles(np.array(places).reshape(-1, 3), str(request.table))
    rig = checked(Rig, {"schema": RIG_SCHEMA, "name": request.table.stem, "lights": tuple(lamps)}, str(request.table))
    write_rig(rig, request.out)
    return rig


def addresses(patch: PatchOptions, primaries: Sequence[str]) -> Iterator[Address]:
    """Yield the addresses of lamps of these primaries, one after another.
    Raises RequestError if a universe is beyond those of the protocol, or a lamp has more channels than a universe."""
    width = len(primaries) * patch.bits // 8
    if width > CHANNELS:
        raise RequestError(f"--primaries: a lamp would have {width} channels, a universe has {CHANNELS}")
    first, last = UNIVERSES[patch.protocol.value]
    universe, channel = patch.universe, 1
    while True:
        if channel + width > CHANNELS + 1:
            universe, channel = universe + 1, 1
        if not first <= universe <= last:
            raise RequestError(f"--universe {patch.universe}: lamps would lie in universe {universe}: {patch.protocol} has {first} to "
                               f"{last}")
        yield Address(protocol="sacn" if patch.protocol is Protocol.SACN else "artnet", universe=universe,
                      host=patch.host,
                      channels={name: channel + index * patch.bits // 8 for index, name in enumerate(primaries)})
        channel += width


def checked(model: type[Part], data: dict[str, Any], where: str) -> Part:
    """Return a part of a rig, or raise ManifestError with what is wrong and where."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        raise ManifestError(f"{where}: {describe(error)}") from error
