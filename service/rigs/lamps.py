"""New lamps of a rig and their addresses, patched one after another."""

from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

from pydantic import ValidationError

from service.errors import RequestError
from service.requests.play import Protocol
from service.requests.rig import PatchOptions
from stage.errors import ManifestError
from stage.model import Strict
from stage.records import describe
from stage.rig.rig import CHANNELS, UNIVERSES, Address

Part = TypeVar("Part", bound=Strict)


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
