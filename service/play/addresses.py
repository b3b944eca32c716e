"""The universes that drive a rig, under the protocol that was asked for."""

from collections.abc import Mapping
from pathlib import Path

from service.errors import RequestError
from service.requests.play import Protocol
from stage.errors import ManifestError, listed
from stage.rig.patch import Universe, patch_faults, slot
from stage.rig.rig import DMX, UNIVERSES, Rig


def with_protocol(rig: Rig, protocol: Protocol | None) -> Rig:
    """Return a rig whose lamps that are driven by DMX have a protocol, or the rig itself where none is asked for.

    Raises:
        RequestError: the protocol does not have a universe.
    """
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

    Args:
        path: of the rig, for messages.

    Raises:
        ManifestError: a lamp cannot be driven, no lamp is driven by DMX, or a universe has several hosts.
    """
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
