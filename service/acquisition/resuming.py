"""A capture goes on with the camera, the settings and the light with which it was begun, or is refused with what has changed."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from service.acquisition.cameras.camera import Picture
from service.acquisition.checks.judge import Judge
from service.acquisition.checks.picture_sample import stride
from service.acquisition.plans.shots import TRACKING, Shot
from service.errors import RequestError
from stage.colour.colour import linearise
from stage.formats import images
from stage.rig.rig import Rig

EXPOSURE_TIMES = ("shutterspeed", "ExposureTime")
"""The exposure time, under the names that cameras give it, which `exposures_s` of a plan sets."""
SAME_LIGHT = 0.06
"""The part by which the light of a picture may differ when it is taken again: half of a sixth of a stop, the finest step of lenses."""
SHADE_PART = 0.05
"""Pixels below this part of the brightest thousandth are left out, as ambient light may be all that they have."""


def refuse_other_settings(folder: Path, earlier: Mapping[str, str], now: Mapping[str, str], shots: Sequence[Shot]) -> None:
    """Refuse to go on where a camera tells another value of a setting than it told when the capture began.
    `folder`: of the capture, for messages. `shots`: of the plan; where it sets exposure times, they may differ. Raises RequestError,
    which names the setting and both values."""
    timed = EXPOSURE_TIMES if any(shot.exposure_s is not None for shot in shots) else ()
    change = _other_setting({name: value for name, value in earlier.items() if name not in timed}, now)
    if change is not None:
        raise RequestError(f"{folder}: {change}, or give another folder to --out and begin again")


def recorded_settings(path: Path) -> dict[str, str]:
    """Return the settings that EXIF in the file of a picture tells, by name."""
    exposure = images.read_header(path).exposure
    told = {"ExposureTime": (exposure.time_s, " s"), "FNumber": (exposure.f_number, ""), "ISO": (exposure.sensitivity, "")}
    return {name: f"{value:.4g}{unit}" for name, (value, unit) in told.items() if value is not None}


def settings_of_files(folder: Path, taken: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return the settings that EXIF in the file of a capture's last picture tells, by the lines of its journal."""
    return recorded_settings(folder / list(taken.values())[-1]["file"]) if taken else {}


def compared_shot(taken: Sequence[Shot], judge: Judge, rig: Rig) -> Shot:
    """Return the shot that is taken again before a capture goes on: the last tracking picture, or else the brightest since a person did
    something, as its light stands far above that of a room; where a person holds the lamps the last one."""
    tracking = next((shot for shot in reversed(taken) if shot.name.endswith(TRACKING)), None)
    if tracking is not None:
        return tracking
    since = max((index for index, shot in enumerate(taken) if shot.prompt is not None), default=0)
    return taken[-1] if _by_hand(taken[-1], rig) else max(taken[since:], key=judge.light)


def change_since(
    earlier: Path,  # the file of the picture that the shot has
    picture: Picture,  # the shot, taken again
    shot: Shot, judge: Judge, rig: Rig,
    space: str,  # the colour space of both
    full_scale: float,  # the recorded value from which readings are clipped
) -> str | None:
    """Return what has changed since a shot was taken, settings, place or light, and what to do; None: nothing."""
    before = images.read_pixels(earlier)
    if (change := _other_setting(_told(earlier, before), _told(picture.path, picture.pixels))) is not None:
        return change
    if shot.lamp is not None and _by_hand(shot, rig):
        return None  # its highlights and shadows are elsewhere each time, like those of something that has moved
    if (fault := judge.compare(shot, before, picture.pixels, space, full_scale)) is not None:
        return f"{fault.sentence} since {shot.key} was taken: put it back"
    if _by_hand(shot, rig) or not (shot.projected or shot.levels.any()):
        return None
    factor = _light_factor(before, picture.pixels, space, full_scale)
    if abs(factor - 1) <= SAME_LIGHT:
        return None
    change = f"brighter by {100 * (factor - 1):.0f} %" if factor > 1 else f"darker by {100 * (1 - factor):.0f} %"
    return f"{shot.key}, taken again, is {change}: set the camera and the lamps as they were"


def _other_setting(earlier: Mapping[str, str], now: Mapping[str, str]) -> str | None:
    """Return the first setting that has another value, and what to do; None: there is none."""
    name = next((name for name, value in earlier.items() if now.get(name, value) != value), None)
    return None if name is None else f"was begun with {name} {earlier[name]}, and the camera has {now[name]} now: set it back"


def _told(path: Path, pixels: np.ndarray) -> dict[str, str]:
    """Return what the file of a picture tells of the settings with which it was taken."""
    return {"file type": path.suffix.lower(), "picture size": f"{pixels.shape[1]}x{pixels.shape[0]}", **recorded_settings(path)}


def _by_hand(shot: Shot, rig: Rig) -> bool:
    """Return whether a person holds a lamp of a shot, which is never at the same place again."""
    shining = {index for (index, _), level in zip(rig.emitters, shot.levels, strict=True) if level > 0}
    return any((address := rig.lights[index].address) is not None and address.protocol == "manual" for index in shining)


def _light_factor(before: np.ndarray, after: np.ndarray, space: str, full_scale: float) -> float:
    """Return the light of a picture over that of another, where both have some and neither is clipped, if there are such pixels."""
    step = stride(before.shape)
    sparse = [np.ascontiguousarray(pixels[::step, ::step], dtype=np.float32) for pixels in (before, after)]
    whole = np.maximum(*(pixels.max(axis=2) for pixels in sparse)) < full_scale
    first, second = (linearise(pixels, space).mean(axis=2) for pixels in sparse)
    both = first + second
    kept = whole if whole.any() else np.ones_like(whole)
    lit = kept & (both > SHADE_PART * np.quantile(both[kept], 0.999))
    total = float(first[lit].sum())
    return float(second[lit].sum()) / total if total > 0 else 1.0
