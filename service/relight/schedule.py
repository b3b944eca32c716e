"""Schedule the lighting of each frame from options and light keys: environment map and its turn, discs, captured images, exposure."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from service.errors import RequestError
from service.relight.environments import Environments
from service.requests.drive import DriveRequest
from service.requests.light.light_keys import CapturedTrack, EnvironmentKey, Key, LightKeys, LightTrack
from service.requests.relight import RelightRequest
from stage.model import Vector
from stage.transforms import rotation_about, rotation_about_y

UPRIGHT = (0.0, 1.0, 0.0)
AnyKey = TypeVar("AnyKey", bound=Key)


class TurnedEnvironment(NamedTuple):
    """The environment of one frame."""

    path: Path
    turn_degrees: float
    axis: tuple[float, float, float]
    rotation: np.ndarray  # [3, 3] float64: turned = rotation @ direction
    exposure_stops: float
    """Exposure of the environment alone."""


class Disc(NamedTuple):
    """A far disc of even radiance."""

    direction: np.ndarray  # [3] float64, unit, from the surface to the middle of the disc
    irradiance: np.ndarray  # [3] float64, on a surface that faces the disc, in `color_space`
    angle_degrees: float
    color_space: str


class ScheduledFrame(NamedTuple):
    """The lighting of one frame."""

    number: int
    environment: TurnedEnvironment | None
    discs: tuple[Disc, ...]
    captured: dict[str, float]
    """Image name → how much of that image is added."""
    exposure_stops: float
    """Exposure of the whole frame."""

    @property
    def metadata(self) -> dict[str, str]:
        """String attributes for the frame's file."""
        found = {"relit:frame": str(self.number)}
        if self.environment is not None:
            found["relit:turn_degrees"] = f"{self.environment.turn_degrees:.6g}"
            if self.environment.axis != UPRIGHT:
                found["relit:turn_axis"] = " ".join(f"{part:.6g}" for part in self.environment.axis)
        if self.exposure_stops:
            found["relit:exposure_stops"] = f"{self.exposure_stops:.6g}"
        return found


def schedule(request: RelightRequest | DriveRequest, numbers: Sequence[int], keys: LightKeys | None,
             environments: Environments | None) -> list[ScheduledFrame]:
    """Return what lights each of the numbered frames of a range, by the content of `request.keys` and the maps of `request.environment`.
    Raises RequestError: nothing lights the frames, or two options turn the environment, or keys turn one that is not there."""
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
        environment = None
        if environments is not None and keys is not None and turned:
            environment = _keyed_environment(environments.path(number), keys.environment, number)
        elif environments is not None:
            turn = request.spin_degrees * index / len(numbers)
            environment = TurnedEnvironment(environments.path(number), turn, UPRIGHT, rotation_about_y(turn), 0.0)
        exposure = request.exposure
        if keys is None:
            result.append(ScheduledFrame(number, environment, (), {}, exposure))
            continue
        if keys.exposure:
            one, other, part = keys_around(keys.exposure, number)
            exposure += float(lerp(one.stops, other.stops, part))
        discs = tuple(_disc(track, number) for track in keys.lights)
        result.append(ScheduledFrame(number, environment, discs, _captured(keys.captured, number), exposure))
    return result


def _keyed_environment(path: Path, keys: Sequence[EnvironmentKey], number: int) -> TurnedEnvironment:
    one, other, part = keys_around(keys, number)
    turn, exposure = lerp((one.turn_degrees, one.exposure), (other.turn_degrees, other.exposure), part)
    x, y, z = slerp(one.axis, other.axis, part)
    axis = float(x), float(y), float(z)
    return TurnedEnvironment(path, float(turn), axis, rotation_about(axis, float(turn)), float(exposure))


def _disc(track: LightTrack, number: int) -> Disc:
    one, other, part = keys_around(track.keys, number)
    return Disc(slerp(one.direction, other.direction, part), lerp(one.irradiance, other.irradiance, part),
                float(lerp(one.angle_degrees, other.angle_degrees, part)), track.color_space)


def _captured(tracks: Sequence[CapturedTrack], number: int) -> dict[str, float]:
    weights: dict[str, float] = {}
    for track in tracks:
        one, other, part = keys_around(track.keys, number)
        weights[track.image] = weights.get(track.image, 0.0) + float(lerp(one.weight, other.weight, part))
    return weights


def keys_around(keys: Sequence[AnyKey], frame: int) -> tuple[AnyKey, AnyKey, float]:
    """Return the keys around a frame and its fraction of the way from one to the other; before the first and after the last key their
    values hold."""
    after = next((index for index, key in enumerate(keys) if key.frame > frame), len(keys))
    if after == 0 or after == len(keys) or keys[after - 1].interpolation == "step":
        held = keys[max(0, after - 1)]
        return held, held, 0.0
    one, other = keys[after - 1], keys[after]
    return one, other, (frame - one.frame) / (other.frame - one.frame)


def lerp(first: float | Sequence[float], second: float | Sequence[float], fraction: float) -> np.ndarray:
    """Return the linear interpolation of two values, float64."""
    return (1 - fraction) * np.asarray(first, dtype=np.float64) + fraction * np.asarray(second, dtype=np.float64)


def slerp(first: Vector, second: Vector, fraction: float) -> np.ndarray:
    """Return the unit vector on the shorter great circle between two, at an even pace.

    Source: Shoemake, "Animating Rotation with Quaternion Curves", SIGGRAPH 1985 (slerp).
    """
    one, other = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    sine = float(np.linalg.norm(np.cross(one, other)))
    angle = float(np.arctan2(sine, one @ other))
    if sine < 1e-12:  # the same direction: there is no way between
        return one
    return (np.sin((1 - fraction) * angle) * one + np.sin(fraction * angle) * other) / sine
