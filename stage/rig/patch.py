"""The patch of a rig: which lamps lie on which channels, what is wrong with it, and the DMX values of levels."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from stage.rig.rig import CHANNELS, DMX, FixedChannel, Lamp, Primary, Rig


class Universe(NamedTuple):
    """A universe that a rig sends."""

    protocol: str
    number: int
    host: str | None


class Slot(NamedTuple):
    """The place of a primary in its universe."""

    universe: Universe
    channel: int
    """The coarse channel, from 1."""
    bits: int


def slot(lamp: Lamp, primary: Primary) -> Slot | None:
    """Return the place of a primary of a lamp, or None if it is not driven by DMX or not patched."""
    address = lamp.address
    if address is None or address.protocol not in DMX or address.universe is None or primary.name not in address.channels:
        return None
    return Slot(Universe(address.protocol, address.universe, address.host), address.channels[primary.name], lamp.bits)


def fixed_channels(lamp: Lamp) -> list[tuple[Universe, FixedChannel]]:
    """Return the channels of a lamp that keep one value, each with its universe."""
    address = lamp.address
    if address is None or address.universe is None:
        return []
    return [(Universe(address.protocol, address.universe, address.host), each) for each in address.fixed]


def patch_faults(rig: Rig) -> Iterator[str]:
    """Yield what keeps lamps of a rig from being driven, as `field: what is wrong`."""
    taken: dict[tuple[str, int, str | None, int], str] = {}
    for index, lamp in enumerate(rig.lights):
        where = f"lights[{index}].address"
        if lamp.address is None:
            yield f"{where}: is missing: the lamp {lamp.name} cannot be driven"
            continue
        if lamp.address.protocol not in DMX:
            continue
        for primary in lamp.primaries:
            place = slot(lamp, primary)
            if place is None:
                yield f"{where}.channels: the primary {primary.name} of the lamp {lamp.name} has no channel"
                continue
            for channel in range(place.channel, place.channel + place.bits // 8):
                if channel > CHANNELS:
                    yield f"{where}.channels.{primary.name}: the fine channel of {place.channel} is beyond {CHANNELS}"
                    continue
                name = f"{primary.name} of {lamp.name}"
                other = taken.setdefault((*place.universe, channel), name)
                if other != name:
                    yield f"{where}.channels.{primary.name}: channel {channel} of universe {place.universe.number} is already {other}"
        for number, (universe, each) in enumerate(fixed_channels(lamp)):
            name = f"{each.name} at {each.value}"  # which several lamps may share
            other = taken.setdefault((*universe, each.channel), name)
            if other != name:
                yield f"{where}.fixed[{number}].channel: channel {each.channel} of universe {universe.number} is already {other}"


def drive_for_light(light: np.ndarray, primary: Primary) -> np.ndarray:
    """Return the drive, 0 to 1, at which a primary gives a fraction 0 to 1 of its light at full level."""
    if primary.response is None:
        return np.asarray(light, dtype=np.float64)
    drive, given = np.array(primary.response).T
    kept = np.append(np.diff(given) > 0, True)  # of a flat part its end, from which light rises
    return np.where(np.asarray(light) > 0, np.interp(light, given[kept], drive[kept]), 0.0)


def light_at_drive(drive: np.ndarray, primary: Primary) -> np.ndarray:
    """Return the fraction of its light at full level that a primary gives at a drive, 0 to 1."""
    if primary.response is None:
        return np.asarray(drive, dtype=np.float64)
    return np.interp(drive, *np.array(primary.response).T)


def drive_steps(rig: Rig, levels: np.ndarray) -> np.ndarray:
    """Return the drive of each of `rig.emitters` in steps of its bits, the nearest to levels [frames, emitters], 0 to 1: int64 alike."""
    columns = [np.rint(drive_for_light(levels[:, column], primary) * (2 ** rig.lights[index].bits - 1))
               for column, (index, primary) in enumerate(rig.emitters)]
    return np.stack(columns, axis=1).astype(np.int64)


def universe_values(rig: Rig, steps: np.ndarray) -> dict[Universe, np.ndarray]:
    """Return the values of all channels of the universes of a rig.
    `steps`: [frames, emitters] integers, the drive of each of `rig.emitters` in steps of its bits: 0…255 or 0…65535. Returns [frames, 512]
    uint8 by universe, in the order of protocol and number."""
    found: dict[Universe, np.ndarray] = {}
    for column, (index, primary) in enumerate(rig.emitters):
        place = slot(rig.lights[index], primary)
        if place is None:
            continue
        values = found.setdefault(place.universe, np.zeros((len(steps), CHANNELS), dtype=np.uint8))
        if place.bits == 16:
            values[:, place.channel - 1] = steps[:, column] >> 8
            values[:, place.channel] = steps[:, column] & 255
        else:
            values[:, place.channel - 1] = steps[:, column]
    for lamp in rig.lights:
        for universe, each in fixed_channels(lamp):
            found.setdefault(universe, np.zeros((len(steps), CHANNELS), dtype=np.uint8))[:, each.channel - 1] = each.value
    return {universe: found[universe] for universe in sorted(found, key=lambda each: (each.protocol, each.number, each.host or ""))}


def levels_of_universes(rig: Rig, values: dict[tuple[str, int], np.ndarray]) -> np.ndarray:
    """Return the light of each of `rig.emitters`, 0 to 1, when universes have these values.

    What is not received is dark, and so is a lamp whose fixed channels have other values than the rig says: its light is not known then.
    `values`: [512] uint8 by protocol and number of the universe."""
    levels = np.zeros(len(rig.emitters))
    nothing = np.zeros(CHANNELS, dtype=np.uint8)
    ready = [all(values.get(universe[:2], nothing)[each.channel - 1] == each.value for universe, each in fixed_channels(lamp))
             for lamp in rig.lights]
    for column, (index, primary) in enumerate(rig.emitters):
        place = slot(rig.lights[index], primary)
        received = None if place is None else values.get((place.universe.protocol, place.universe.number))
        if place is None or received is None or not ready[index]:
            continue
        step = int(received[place.channel - 1])
        if place.bits == 16:
            step = step * 256 + int(received[place.channel])
        levels[column] = light_at_drive(np.array(step / (2**place.bits - 1)), primary)
    return levels
