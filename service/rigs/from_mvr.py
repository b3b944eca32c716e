"""Make a rig of the fixtures of a scene in My Virtual Rig (MVR)."""

from collections import Counter
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from service.errors import RequestError
from service.requests.rig import RigFromMvrRequest
from service.rigs.from_capture import checked
from stage import inputs
from stage.errors import ManifestError
from stage.rig.rig import CHANNELS, RIG_SCHEMA, Lamp, Rig, write_rig

if TYPE_CHECKING:  # these import packages that may be missing
    from service.rigs.gdtf import Cell, Mode
    from service.rigs.mvr import Fixture

RIG_FROM_SCENE = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""A scene has z up and y away from the viewer, a rig y up and z towards the viewer."""


class MadeRig(NamedTuple):
    """A rig that was made, and what the scene did not say."""

    rig: Rig
    warnings: list[str]


def rig_from_mvr(request: RigFromMvrRequest) -> MadeRig:
    """Write the rig of a scene and return it.
    Raises RequestError if a package is missing. Raises ManifestError if the scene is wrong; names the fixture. Raises StorageError if the
    scene cannot be read, or the rig not be written."""
    try:
        from service.rigs.gdtf import read_mode
        from service.rigs.mvr import read_scene
    except ModuleNotFoundError as error:
        raise RequestError(f"scenes are read with the package {error.name}, which is not installed: pip install 'relit[set]'") from error
    scene = read_scene(inputs.read_bytes(request.scene), str(request.scene))
    if not scene.fixtures:
        raise ManifestError(f"{request.scene}: has no fixtures")
    warnings = ["the irradiances are nominal, a scene has none: measure those of your lamps (relit calibrate rig)"]
    modes: dict[tuple[str | None, str | None], Mode] = {}
    lamps: list[Lamp] = []
    names = _names([(fixture.name, fixture.identity) for fixture in scene.fixtures])
    for fixture, name in zip(scene.fixtures, names, strict=True):
        where = f"{request.scene}: fixture {name}"
        if fixture.copies is not None:
            warnings.append(f"{where}: shares the channels of another fixture, and is left out")
            continue
        kind = fixture.type_file, fixture.mode
        if kind not in modes:
            content = scene.type_content(fixture)
            if content is None:
                raise ManifestError(f"{where}: " + (f"its type {fixture.type_file} is not in the scene" if fixture.type_file else
                                                    "has no GDTF file, which says what its channels drive"))
            modes[kind] = read_mode(content, fixture.mode, f"{request.scene}: {fixture.type_file}")
            warnings += modes[kind].warnings
        for cell in modes[kind].cells:
            lamp, missing = _lamp(request, fixture, cell, name)
            lamps.append(lamp)
            warnings += missing
    if not lamps:
        raise ManifestError(f"{request.scene}: has no fixtures with emitters that Relit can drive")
    rig = checked(Rig, {"schema": RIG_SCHEMA, "name": request.scene.stem, "lights": tuple(lamps),
                        "subject_m": _turned(request.subject)}, str(request.scene))
    write_rig(rig, request.out)
    return MadeRig(rig, warnings)


def _lamp(request: RigFromMvrRequest, fixture: "Fixture", cell: "Cell", name: str) -> tuple[Lamp, list[str]]:
    """Return the lamp of a cell of a fixture of this name, and what the scene does not give it, as sentences."""
    if cell.name:
        name = f"{name}.{cell.name}"
    where = f"{request.scene}: lamp {name}"
    missing = []
    fine = [len(emitter.offsets) > 1 and emitter.offsets[1] == emitter.offsets[0] + 1 for emitter in cell.emitters]
    if not all(fine) and any(len(emitter.offsets) > 1 for emitter in cell.emitters):
        missing.append(f"{where}: is driven with 8 bits: not every primary has a fine channel right after its coarse one")
    address = _address(request, {emitter.name: fixture.addresses[emitter.dmx_break] + emitter.offsets[0]
                                 for emitter in cell.emitters if emitter.dmx_break in fixture.addresses}, where)
    if address is None:
        missing.append(f"{where}: has no address")
    else:
        address["fixed"], elsewhere = _fixed(fixture, cell, address["universe"] - request.universe)
        missing += [f"{where}: its {name} lies in another universe than its primaries, and is not driven" for name in elsewhere]
    place = fixture.scene_from_fixture @ (*cell.place_mm, 1.0)
    primaries = [{"name": emitter.name, "irradiance": tuple((request.irradiance * emitter.irradiance).tolist())}
                 for emitter in cell.emitters]
    return checked(Lamp, {"name": name, "type": "point", "position_m": _turned(place[:3] / 1000), "bits": 16 if all(fine) else 8,
                          "address": address, "primaries": primaries}, where), missing


def _turned(place: ArrayLike) -> tuple[float, ...]:
    """Return a place in a scene as one in the rig; adding 0 makes zeros positive."""
    return tuple((RIG_FROM_SCENE @ np.asarray(place) + 0.0).tolist())


def _address(request: RigFromMvrRequest, channels: dict[str, int], where: str) -> dict[str, Any] | None:
    """Return the address of a lamp, or None if it has none.
    `channels`: of each primary, counted through all universes of the scene from 0. Raises ManifestError if the channels lie in several
    universes."""
    if not channels:
        return None
    universes = sorted({channel // CHANNELS for channel in channels.values()})
    if len(universes) > 1:
        raise ManifestError(f"{where}: its channels lie in the universes {', '.join(str(number + 1) for number in universes)}: "
                            "patch it within one")
    return {"protocol": request.protocol.value, "universe": request.universe + universes[0],
            "channels": {name: channel % CHANNELS + 1 for name, channel in channels.items()}}


def _fixed(fixture: "Fixture", cell: "Cell", universe: int) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the channels of a lamp that keep one value, and the names of those outside of a universe of the scene, from 0."""
    found, elsewhere = [], []
    for held in cell.fixed:
        first = fixture.addresses.get(held.dmx_break)
        for offset, value in zip(held.offsets, held.values, strict=False):
            number, channel = divmod(-CHANNELS if first is None else first + offset, CHANNELS)
            if number == universe:
                found.append({"name": held.name, "channel": channel + 1, "value": value})
            elif held.name not in elsewhere:
                elsewhere.append(held.name)
    return found, elsewhere


def _names(given: list[tuple[str, str]]) -> list[str]:
    """Return names that differ, of the names of fixtures and their IDs, which stand where a name is not the only one."""
    often = Counter(name for name, _ in given)
    found: list[str] = []
    taken = set[str]()
    for name, identity in given:
        base = f"{name} {identity}" if often[name] > 1 and identity else name
        new, count = base, 1
        while new in taken:
            count += 1
            new = f"{base}-{count}"
        taken.add(new)
        found.append(new)
    return found
