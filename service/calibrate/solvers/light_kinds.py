"""The kinds of light of a capture: frames whose lights have one colour, and whose polarisers stand alike, share a matrix of colours."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stage.capture.light import DistantLight, ExtendedLight, Light, OffLight, PointLight
from stage.capture.manifest import Manifest

ALIKE = 0.05
"""The largest difference between channels of the irradiances of two lights of one kind, whose channels add up to 1: lamps of one make
differ by less, their primaries and whites by more."""


class LightKind(NamedTuple):
    """Frames under light of one kind."""

    polarization: str
    colour: tuple[float, float, float] | None
    """Red, green and blue of its irradiance, which add up to 1; None: the lights declare none."""
    frames: tuple[int, ...]
    """Their indices in the manifest."""

    def words(self, manifest: Manifest) -> str:
        """Return the light in words, as far as it tells kinds apart."""
        named = [] if self.polarization == "none" else [f"{self.polarization}-polarised"]
        count = f"{len(self.frames)} frames" if len(self.frames) > 1 else manifest.frames[self.frames[0]].image
        colour = "" if self.colour is None else f" of the colour {' '.join(f'{value / max(self.colour):.2f}' for value in self.colour)}"
        return f"{' '.join([*named, 'light'])}{colour} ({count})"

    def shines_alike(self, other: "LightKind") -> bool:
        """Return whether both have one colour, as far as they declare it."""
        return self.colour is None or other.colour is None or bool(np.abs(np.subtract(self.colour, other.colour)).max() < ALIKE)


def kinds_of(manifest: Manifest) -> list[LightKind]:
    """Return the kinds of light of the frames with a light, those of most frames first; `off` frames belong to none.

    Frames whose light declares no colour belong to the largest kind with their polarisation.
    """
    kinds: list[LightKind] = []
    plain: list[LightKind] = []
    for index, frame in enumerate(manifest.frames):
        if frame.light is None or isinstance(frame.light, OffLight):
            continue
        one = LightKind(getattr(frame.light, "polarization", "none"), _colour(frame.light), (index,))
        _join(plain if one.colour is None else kinds, one)
    kinds.sort(key=lambda kind: -len(kind.frames))
    for one in plain:
        _join(kinds, one)
    return sorted(kinds, key=lambda kind: -len(kind.frames))


def matching_kind(kind: LightKind, among: Sequence[LightKind]) -> int | None:
    """Return the index of the kind with the polarisation of a kind and its colour, or of the only one with its polarisation; else None."""
    alike = [index for index, other in enumerate(among) if other.polarization == kind.polarization]
    found = next((index for index in alike if among[index].shines_alike(kind)), None)
    return alike[0] if found is None and len(alike) == 1 else found


def _join(kinds: list[LightKind], one: LightKind) -> None:
    place = matching_kind(one, kinds) if one.colour is None else next(
        (index for index, kind in enumerate(kinds) if kind.polarization == one.polarization and kind.shines_alike(one)), None)
    if place is None:
        kinds.append(one)
    else:
        kinds[place] = kinds[place]._replace(frames=(*kinds[place].frames, *one.frames))


def _colour(light: Light) -> tuple[float, float, float] | None:
    if isinstance(light, DistantLight):
        strength = np.array(light.irradiance)
    elif isinstance(light, PointLight):
        strength = np.array(light.intensity)
    elif isinstance(light, ExtendedLight):
        strength = np.array(light.solid_angle) @ np.array(light.radiance)
    else:
        return None
    red, green, blue = (float(value) for value in strength / strength.sum())
    return red, green, blue
