"""The plan of a relight: its captures and frames. All cheap checks are done before an image is read or anything is written.

The lights of a frame can be kept apart: a layer for the environment, and for each light and captured image of the light keys. Light is
additive, so these layers add up to the frame, and each can be made brighter or dimmer in a compositing program.
"""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.errors import RequestError
from service.relight.attributes import FRAMES_PER_SECOND
from service.relight.environments import Environments
from service.relight.layers import check_layers, maps_file
from service.relight.outputs import check_outputs, display_path, frame_path
from service.relight.schedule import ScheduledFrame, schedule
from service.relight.time_steps import capture_files, time_steps
from service.requests.light.frame_range import frame_numbers, part_of
from service.requests.light.light_keys import LightKeys
from service.requests.light.picture_options import Layer
from service.requests.relight import RelightRequest


class PlannedFrame(NamedTuple):
    """A frame that will be made, and what lights it."""

    path: Path
    scheduled: ScheduledFrame
    position: int
    """Position of the frame in the whole range, from 0."""


class Plan(NamedTuple):
    """The frames that a relight will make."""

    folders: tuple[Path, ...]
    """One capture, or one a time step."""
    frames: tuple[PlannedFrame, ...]
    """The frames that this run makes."""
    total: int
    """Number of frames in the whole range."""
    environments: Environments | None
    keys: LightKeys | None
    rate: float
    """Frames per second."""
    groups: tuple[str, ...]
    """The names of the layers of single lights; empty where none are wanted."""

    @property
    def is_sequence(self) -> bool:
        """True where there are several captures, which give one frame each."""
        return len(self.folders) > 1

    def captures(self) -> Iterator[tuple[Path, tuple[PlannedFrame, ...]]]:
        """Yield each capture's folder and its frames."""
        if not self.is_sequence:
            yield self.folders[0], self.frames
            return
        for frame in self.frames:
            yield self.folders[frame.position], (frame,)


def make_plan(request: RelightRequest) -> Plan:
    """Check a request and return what it makes.

    Raises:
        RequestError: a bad frame range, a pattern without ####, options that do not fit, or an output that would replace an input.
        StageError: a map, the light keys or a manifest is wrong; names file and field.
        StorageError: a folder cannot be written to.
    """
    folders = time_steps(request.capture)
    numbers = frame_numbers(request.frames, len(folders))
    paths = [frame_path(request.out, number) for number in numbers]
    made = range(numbers[0], numbers[-1] + 1) if request.only is None else part_of(numbers, request.only)
    outputs = [(f"--out {request.out}", path) for path in paths]
    check_layers(request, request.maps)
    request.require_picture(sheet=request.sheet, display=request.display)
    if request.display is not None:
        outputs += [(f"--display {request.display}", display_path(request.display, number)) for number in numbers]
    if request.sheet is not None:
        if request.only is not None:
            raise RequestError(f"--sheet {request.sheet} shows the whole range, --only {request.only} makes a part of it: give one of them")
        if request.sheet.suffix.lower() != ".png":
            raise RequestError(f"--sheet {request.sheet}: a contact sheet is a PNG: end the name in .png")
        outputs.append((f"--sheet {request.sheet}", request.sheet))
    if request.nuke is not None:
        if Layer.LIGHTS not in request.aov:
            raise RequestError(f"--nuke {request.nuke}: mixes layers of lights: give --aov lights too")
        if request.only is not None or request.nuke.suffix.lower() != ".nk":
            raise RequestError(f"--nuke {request.nuke}: " + ("end the name in .nk" if request.only is None else
                               f"is for the whole range, --only {request.only} makes a part of it: give one of them"))
        outputs.append((f"--nuke {request.nuke}", request.nuke))
    if request.report is not None:
        outputs.append((f"--report {request.report}", request.report))
    keys = LightKeys.read(request.keys) if request.keys is not None else None
    environments = None if request.environment is None else Environments(request.environment, clip_negative=request.clip_negative,
                                                                         spin_degrees=request.spin_degrees)
    scheduled = schedule(request, numbers, keys, environments)
    groups = group_names(environments is not None, keys) if Layer.LIGHTS in request.aov else ()
    if environments is not None:
        environments.check(made)

    def inputs() -> Iterator[Path]:
        yield from ([] if request.keys is None else [request.keys])
        yield from {frame.environment.path for frame in scheduled if frame.environment is not None}
        for folder in folders:
            yield from capture_files(folder)
            if request.maps is not None:
                yield maps_file(request.maps, folder, len(folders))

    check_outputs(outputs, inputs())
    planned = (PlannedFrame(*frame) for frame in zip(paths, scheduled, range(len(paths)), strict=True))
    return Plan(tuple(folders), tuple(frame for frame in planned if frame.scheduled.number in made), len(numbers), environments, keys,
                _rate(request, keys), groups)


def _rate(request: RelightRequest, keys: LightKeys | None) -> float:
    """Return the frames per second of a request and its light keys, which may not differ."""
    wanted, keyed = request.frames_per_second, None if keys is None else keys.frames_per_second
    if wanted is not None and keyed is not None and wanted != keyed:
        raise RequestError(f"--frames-per-second {wanted:g}: {request.keys} has frames_per_second {keyed:g}: give one of them")
    return wanted or keyed or FRAMES_PER_SECOND


MOST_GROUPS = 32
"""The most layers of lights: a frame of 2048 × 1152 pixels then has half a gigabyte before compression."""
PREFIX = "light_"


def group_names(has_environment: bool, keys: LightKeys | None) -> tuple[str, ...]:
    """Return the name of the layer of each light, MOST_GROUPS at most: letters, digits and underscores, each name once."""
    wanted = ["environment"] if has_environment else []
    if keys is not None:
        wanted += [track.name for track in keys.lights] + [image.rsplit(".", 1)[0] for image in _images(keys)]
    if len(wanted) > MOST_GROUPS:
        raise RequestError(f"--aov lights: the frames have {len(wanted)} lights: there are at most {MOST_GROUPS} layers of lights")
    names: list[str] = []
    for number, text in enumerate(wanted, start=1):
        plain = re.sub(r"[^A-Za-z0-9_]+", "_", text).strip("_") or str(number)
        name = PREFIX + plain
        if name in names:
            name = f"{name}_{number}"
        while name in names:
            name += "_"
        names.append(name)
    return tuple(names)


def in_groups(frame: ScheduledFrame, keys: LightKeys | None) -> tuple[ScheduledFrame, ...]:
    """Return a frame for each light alone, in the order of `group_names`."""
    dark = frame._replace(environment=None, discs=(), captured={})
    alone = [dark._replace(environment=frame.environment)] if frame.environment is not None else []
    alone += [dark._replace(discs=(disc,)) for disc in frame.discs]
    return (*alone, *(dark._replace(captured={image: frame.captured[image]}) for image in (_images(keys) if keys is not None else ())))


def add_up(groups: Sequence[np.ndarray], whole: np.ndarray) -> None:
    """Scale the pictures of lights, each alone [frames, 3, pixels] and changed in place, so that they add up to the whole at every pixel.

    A model of maps that corrects pictures does so less for their sum than for each of them; where they add up to nothing, the first takes
    what the whole holds.
    """
    total = np.sum(groups, axis=0)
    scale = np.divide(whole, total, out=np.zeros_like(whole), where=np.abs(total) > np.finfo(np.float32).tiny)
    for group in groups:
        group *= scale
    groups[0][...] += np.where(scale == 0, whole, 0)


def _images(keys: LightKeys) -> list[str]:
    return list(dict.fromkeys(track.image for track in keys.captured))
