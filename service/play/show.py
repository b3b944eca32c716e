"""The show that is played: the values of every universe in every frame, checked before anything is sent."""

from collections.abc import Iterable, Mapping
from itertools import cycle, repeat
from typing import NamedTuple

from service.errors import RequestError
from service.play.addresses import driven_universes, hosts_of, with_protocol
from service.requests.play import PlayRequest
from stage.errors import ManifestError
from stage.rig.cues import Cues, FrameCue, read_cues
from stage.rig.rig import CHANNELS, read_rig

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

    Raises:
        RequestError: the cues do not have the frame that is to be held, or the protocol a universe.
        StageError: the cues or the rig are wrong, or do not fit each other; names file and field.
    """
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
