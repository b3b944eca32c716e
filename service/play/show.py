"""The show that is played: the universes that drive a rig and their values in every frame, checked before anything is sent."""

from collections.abc import Iterable, Mapping
from itertools import cycle, repeat
from pathlib import Path
from typing import NamedTuple

from service.errors import RequestError
from service.requests.play import PlayRequest, Protocol
from stage.errors import ManifestError, listed
from stage.rig.cues import Cues, FrameCue, read_cues
from stage.rig.patch import Universe, patch_faults, slot
from stage.rig.rig import CHANNELS, DMX, UNIVERSES, Rig, read_rig

Values = dict[str, dict[int, bytes]]
"""The values of a frame by protocol and number of the universe."""


class Show(NamedTuple):
    """Frames to be sent."""

    hosts: dict[str, dict[int, str | None]]
    """The host of each universe, by protocol and number."""
    frames: tuple[Values, ...]
    order: Iterable[int]
    """The positions of the frames in the order in which they are sent; without end for a loop or a held frame."""
    frames_per_second: float

    @property
    def dark(self) -> Values:
        """The values of a frame in which every lamp is dark."""
        return dark_values(self.hosts)


def dark_values(hosts: Mapping[str, Iterable[int]]) -> Values:
    """Return the values of a frame in which every lamp is dark, for the universes of each protocol."""
    return {protocol: dict.fromkeys(numbers, bytes(CHANNELS)) for protocol, numbers in hosts.items()}


def read_show(request: PlayRequest) -> Show:
    """Read the cues and the rig of a request.
    Raises RequestError if the cues do not have the frame that is to be held, or the protocol a universe. Raises StageError if the cues or
    the rig are wrong, or do not fit each other; names file and field."""
    rig = read_rig(request.rig)
    cues = read_cues(request.cues, rig)
    universes = driven_universes(request.rig, with_protocol(rig, request.protocol))
    hosts = hosts_of(universes, request.host)
    frames = tuple(_values(frame, f"{request.cues}: frames[{index}].dmx", request, hosts) for index, frame in enumerate(cues.frames))
    return Show(hosts, frames, _order(cues, request), request.frames_per_second or cues.frames_per_second)


def _values(frame: FrameCue, where: str, request: PlayRequest, hosts: dict[str, dict[int, str | None]]) -> Values:
    found: Values = {protocol: {} for protocol in hosts}
    for cue in frame.dmx:
        protocol = str(request.protocol or cue.protocol)
        if cue.universe in found.setdefault(protocol, {}):
            raise ManifestError(f"{where}: has universe {cue.universe} twice" + ("" if request.protocol is None else
                                f": with --protocol {protocol} those of both protocols would be one"))
        found[protocol][cue.universe] = bytes(cue.values)
    for protocol, numbers in hosts.items():
        if missing := sorted(numbers.keys() - found[protocol].keys()):
            raise ManifestError(f"{where}: lacks {protocol} universe {missing[0]} of the rig: run relit drive again")
    return {protocol: {number: found[protocol][number] for number in numbers} for protocol, numbers in hosts.items()}


def _order(cues: Cues, request: PlayRequest) -> Iterable[int]:
    numbers = [frame.frame for frame in cues.frames]
    if request.hold is not None:
        if request.hold not in numbers:
            raise RequestError(f"--hold {request.hold}: {request.cues} has frames {numbers[0]} to {numbers[-1]}")
        return repeat(numbers.index(request.hold))
    return cycle(range(len(numbers))) if request.loop else range(len(numbers))


def with_protocol(rig: Rig, protocol: Protocol | None) -> Rig:
    """Return a rig whose lamps that are driven by DMX have a protocol, or the rig itself where none is asked for.
    Raises RequestError if the protocol does not have a universe."""
    if protocol is None:
        return rig
    first, last = UNIVERSES[protocol]
    lights = []
    for lamp in rig.lights:
        if lamp.address is not None and lamp.address.protocol in DMX and lamp.address.universe is not None:
            if not first <= lamp.address.universe <= last:
                raise RequestError(f"--protocol {protocol} has universes {first} to {last}: the lamp {lamp.name} is in universe "
                                   f"{lamp.address.universe}")
            lamp = lamp.model_copy(update={"address": lamp.address.model_copy(update={"protocol": str(protocol)})})
        lights.append(lamp)
    return rig.model_copy(update={"lights": tuple(lights)})


def driven_universes(path: Path, rig: Rig) -> dict[tuple[str, int], Universe]:
    """Return the universes of a rig by protocol and number.
    `path`: of the rig, for messages. Raises ManifestError if a lamp cannot be driven, no lamp is driven by DMX, or a universe has several
    hosts."""
    if faults := listed((f"{path}: {fault}" for fault in patch_faults(rig)), f"{path}: has further faults: mend these first"):
        raise ManifestError(*faults)
    found: dict[tuple[str, int], Universe] = {}
    for index, primary in rig.emitters:
        place = slot(rig.lights[index], primary)
        if place is None:
            continue
        universe = found.setdefault(place.universe[:2], place.universe)
        if universe != place.universe:
            raise ManifestError(f"{path}: lights[{index}].address.host: is {place.universe.host or 'not given'}, other lamps of universe "
                                f"{universe.number} have {universe.host or 'none'}: give one host for each universe")
    if not found:
        raise ManifestError(f"{path}: lights[].address: no lamp has a sacn or artnet address: patch the lamps")
    return dict(sorted(found.items()))


def hosts_of(universes: Mapping[tuple[str, int], Universe], host: str | None = None) -> dict[str, dict[int, str | None]]:
    """Return the host of each universe, by protocol and number; `host` is that of all of them, None: each has that of its address."""
    found: dict[str, dict[int, str | None]] = {}
    for (protocol, number), universe in universes.items():
        found.setdefault(protocol, {})[number] = universe.host if host is None else host
    return found
