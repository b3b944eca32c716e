"""What lights each frame: which map, how it is turned, which discs and captured images are added, at which exposure."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.errors import RequestError
from service.light.environments import Environments
from service.requests.light_keys import CapturedTrack, EnvironmentKey, LightKeys, LightTrack, mixed, span, swung
from service.requests.relight import RelightRequest
from stage.frames import rotation_about, rotation_about_y

UPRIGHT = (0.0, 1.0, 0.0)


class Sky(NamedTuple):
    """The environment of one frame."""

    path: Path
    turn_degrees: float
    axis: tuple[float, float, float]
    rotation: np.ndarray  # [3, 3] float64: turned = rotation @ direction
    stops: float


class Disc(NamedTuple):
    """A far disc of even radiance."""

    direction: np.ndarray  # [3] float64, unit, to its middle
    irradiance: np.ndarray  # [3] float64, on a surface that faces it, in `color_space`
    angle_degrees: float
    color_space: str


class FrameLighting(NamedTuple):
    """What lights one frame."""

    number: int
    sky: Sky | None
    discs: tuple[Disc, ...]
    captured: dict[str, float]
    """Image name → how much of it is added."""
    stops: float
    """Exposure of the whole frame."""

    @property
    def metadata(self) -> dict[str, str]:
        """String attributes for the frame's file."""
        found = {"relit:frame": str(self.number)}
        if self.sky is not None:
            found["relit:turn_degrees"] = f"{self.sky.turn_degrees:.6g}"
            if self.sky.axis != UPRIGHT:
                found["relit:turn_axis"] = " ".join(f"{part:.6g}" for part in self.sky.axis)
        if self.stops:
            found["relit:exposure_stops"] = f"{self.stops:.6g}"
        return found


def schedule(request: RelightRequest, numbers: Sequence[int], keys: LightKeys | None,
             environments: Environments | None) -> list[FrameLighting]:
    """What lights each frame of a range.

    Args:
        request: spin and exposure.
        numbers: of the frames.
        keys: of `request.keys`.
        environments: of `request.environment`.

    Raises:
        RequestError: nothing lights the frames, or two options turn the environment, or keys turn one that is not there.
    """
    if environments is None and (keys is None or not (keys.lights or keys.captured)):
        raise RequestError("nothing lights the frames: give --environment MAP, or --keys FILE with lights or captured images")
    turned = keys is not None and bool(keys.environment)
    if environments is None and (turned or request.spin_degrees):
        option = f"--keys {request.keys}" if turned else f"--spin-degrees {request.spin_degrees:g}"
        raise RequestError(f"{option} turns an environment: give --environment MAP too")
    if turned and request.spin_degrees:
        raise RequestError(f"--spin-degrees {request.spin_degrees:g} and --keys {request.keys} both turn the environment: give one")
    result = []
    for index, number in enumerate(numbers):
        sky = None
        if environments is not None and keys is not None and turned:
            sky = _keyed_sky(environments.path(number), keys.environment, number)
        elif environments is not None:
            turn = request.spin_degrees * index / len(numbers)
            sky = Sky(environments.path(number), turn, UPRIGHT, rotation_about_y(turn), 0.0)
        stops = request.exposure
        if keys is None:
            result.append(FrameLighting(number, sky, (), {}, stops))
            continue
        if keys.exposure:
            at = span(keys.exposure, number)
            stops += float(mixed((keys.exposure[at.first].stops,), (keys.exposure[at.second].stops,), at.fraction)[0])
        discs = tuple(_disc(track, number) for track in keys.lights)
        result.append(FrameLighting(number, sky, discs, _captured(keys.captured, number), stops))
    return result


def _keyed_sky(path: Path, keys: Sequence[EnvironmentKey], number: int) -> Sky:
    at = span(keys, number)
    one, other = keys[at.first], keys[at.second]
    turn, stops = mixed((one.turn_degrees, one.exposure), (other.turn_degrees, other.exposure), at.fraction)
    x, y, z = swung(one.axis, other.axis, at.fraction)
    axis = float(x), float(y), float(z)
    return Sky(path, float(turn), axis, rotation_about(axis, float(turn)), float(stops))


def _disc(track: LightTrack, number: int) -> Disc:
    at = span(track.keys, number)
    one, other = track.keys[at.first], track.keys[at.second]
    return Disc(swung(one.direction, other.direction, at.fraction), mixed(one.irradiance, other.irradiance, at.fraction),
                float(mixed((one.angle_degrees,), (other.angle_degrees,), at.fraction)[0]), track.color_space)


def _captured(tracks: Sequence[CapturedTrack], number: int) -> dict[str, float]:
    weights: dict[str, float] = {}
    for track in tracks:
        at = span(track.keys, number)
        weight = float(mixed((track.keys[at.first].weight,), (track.keys[at.second].weight,), at.fraction)[0])
        weights[track.image] = weights.get(track.image, 0.0) + weight
    return weights
