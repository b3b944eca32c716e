"""A performance: frames of a moving subject under lights that repeat a plan, cut into a sequence of captures, one a period."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.acquisition.acquire import NO_LAMPS
from service.acquisition.capture_files import CaptureFiles
from service.acquisition.checks.picture_sample import sample_of
from service.acquisition.plans.plan import read_plan
from service.acquisition.plans.shots import FLAT, TRACKING, Shot, shots_of
from service.errors import RequestError
from service.requests.imports.patterns import InterleavedImport
from stage.capture.light import FullLight, GradientLight
from stage.capture.sequence import FRAME_RATE, SEQUENCE_FILE, TimeStep, write_sequence
from stage.capture.sequence import Sequence as CaptureSequence
from stage.colour.colour_spaces import ColorSpaceName
from stage.files import folder_beside, replacing_folder
from stage.formats import images
from stage.importers.camera_options import Selection, select
from stage.importers.layout import Imported, color_space_of, image_resolution, place_images
from stage.importers.video import FrameRange, is_video, unpack
from stage.rig.rig import read_rig

CLOSER = 0.5
"""A frame is lit as another one that differs from it by less than this part of what the frame a period before does. A subject that moves
evenly differs from frames up to a third of a period nearer by two thirds of it or more."""
MOST_APART = 3
"""Frames up to this part of a period from the place of a frame are compared with it."""
LEAST_VOTES = 3
"""Number of frames, or a third of the period if that is more, that must agree by how much they are misplaced."""
LEAST_MISFIT, FULL_PART = 0.003, 0.4
"""A frame that is less unlike the mean of its period is lit by all lamps, as an image under a lamp beside the camera may seem to be. Frames
beside the places of tracking frames that are unlike it by less than the second part of what those in the places are, are the tracking
frames. One minus the cosine of both images."""
LEAST_TRACKING = 3
"""Number of consecutive places of tracking frames of which most must say so: in one of them a lamp may have failed."""
LEAST_LAMPS = 4
"""The fewest lamps whose mean is an image under full light."""
ALIKE = 1.5
"""The factor between the light of tracking frames of neighbouring periods; nearly all lamps light them."""
NEAR = 2
"""Number of periods before and after one whose tracking frames are its neighbours."""


class _Frames(NamedTuple):
    """The images of a performance, in order of time."""

    folder: Path
    names: tuple[str, ...]
    mask: str | None
    rate: float | None
    """Frames a second of those that are used; None: nothing says it."""
    facts: tuple[tuple[str, str], ...]
    assumed: tuple[str, ...]


def import_interleaved(request: InterleavedImport) -> Imported:
    """Write a sequence of captures, one for each period of a plan; the folder comes to be whole or not at all.
    Raises RequestError if the plan cannot repeat, or the frames do not repeat it; names what does not fit. Raises StageError if plan, rig,
    an image or the video is wrong, or the folder cannot be written."""
    target = request.destination
    if target is None:
        raise RequestError("DST is missing: give a folder for the sequence behind SRC")
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise RequestError(f"{target}: is there already: give another folder for the sequence")
    rig = NO_LAMPS if request.rig is None else read_rig(request.rig)
    shots = tuple(shot for shot in shots_of(read_plan(request.period), rig, request.projector) if shot.folder != TRACKING)  # of lamps alone
    period, closed = _period(shots, request.period)
    with folder_beside(target) as working, replacing_folder(target) as made:
        frames = _frames(request, working / "frames")
        steps = _count(frames.names, len(period), closed, request)
        space = request.color_space or color_space_of(frames.folder / frames.names[0])
        blocks = _blocks(frames, space)
        if (fault := repetition_fault(blocks, period, frames.names)) is not None:
            raise RequestError(f"{request.source}: {fault}")
        rate = frames.rate or FRAME_RATE * len(period)
        times = [place for place, shot in enumerate(shots) if shot.name.endswith(TRACKING)]
        reference = times[len(times) // 2] if times else 0  # the frame to which those of a step are aligned
        found = []
        for step in range(steps):
            name = f"{step + 1:0{max(4, len(str(steps)))}d}"
            begin = step * len(period)
            chosen = frames.names[begin:begin + len(shots)]
            place_images(frames.folder, made / name, [*chosen, *([frames.mask] if frames.mask else [])])
            taken = {shot.key: {"file": image} for shot, image in zip(shots, chosen, strict=True)}
            CaptureFiles(made / name, rig, shots, request.color_space, request.saturation).write_manifest(
                "", taken, mask=frames.mask, assumed=frames.assumed)
            found.append(TimeStep(name, made / name, (begin + reference) / rate))
        write_sequence(CaptureSequence(tuple(found), rate / len(period), True), made / SEQUENCE_FILE)
    return Imported(target / SEQUENCE_FILE, (
        *frames.facts, ("period", f"{len(period)} frames, {len(times)} of them under full light" if not closed else
                        f"{len(period)} frames, {len(times) - 1} of them under full light; the first of the next period closes each"),
        ("steps", f"{steps}, {rate / len(period):g} a second" + ("" if frames.rate else
                                                                  ", as nothing says the camera's rate: --frame-rate does")),
        ("mask", frames.mask or "none: every pixel is taken"),
        ("then", f"relit {'solve' if rig.lights else 'depth'} {target}{' --align' if len(times) > 1 else ''} --out {target.name}-maps")))


def _period(shots: Sequence[Shot], plan: str) -> tuple[tuple[Shot, ...], bool]:
    """Return the shots of one period, and whether the last shot of the plan is the first of the next period."""
    for shot in shots:
        if shot.prompt is not None:
            raise RequestError(f"--period {plan}: waits for a person ({shot.prompt}), and a period does not")
        if shot.folder or shot.name == FLAT:
            raise RequestError(f"--period {plan}: {shot.folder or FLAT} is an image of something else than the subject: leave it out")
    closed = len(shots) > 1 and shots[0].name.endswith(TRACKING) and shots[-1].name.endswith(TRACKING)
    return tuple(shots[:-1] if closed else shots), closed


def _frames(request: InterleavedImport, folder: Path) -> _Frames:
    """Return the images of a folder, or of a video, which is unpacked into `folder`."""
    chosen = FrameRange.parse(request.frames or "0", "--frames")
    if is_video(request.source):
        for option, value in (("images", request.images), ("mask", request.mask)):
            if value is not None:
                raise RequestError(f"--{option} {value}: {request.source} is a video: it is for a folder of images")
        video = unpack(request.source, folder, chosen if request.frames else FrameRange(0, None, 1))
        names = tuple(sorted(path.name for path in folder.iterdir()))
        recorded = request.frame_rate or video.rate
        return _Frames(folder, names, None, recorded and recorded / chosen.step, (("video", video.sentence),), video.assumed)
    found = select(request.source, Selection(images=request.images, mask=request.mask))
    if found.ambient is not None:
        raise RequestError(f"{request.source}: {found.ambient} is an image of ambient light: take dark into the plan instead, or choose "
                           "the frames with --images")
    names = found.frames
    if request.frames is not None:
        if (chosen.first if chosen.last is None else chosen.last) >= len(names):
            raise RequestError(f"{request.source}: has {len(names)} frames, 0 to {len(names) - 1}, and --frames asks for {request.frames}")
        names = names[chosen.first:None if chosen.last is None else chosen.last + 1:chosen.step]
    said = f"{len(names)} of {len(found.frames)} images in their order, {names[0]} to {names[-1]}"
    return _Frames(request.source, names, found.mask, request.frame_rate and request.frame_rate / chosen.step, (("frames", said),), ())


def _count(names: Sequence[str], length: int, closed: bool, request: InterleavedImport) -> int:
    steps, left = divmod(len(names) - closed, length)
    if steps > 0 and left == 0:
        return steps
    needed = f"{length} frames" + (", and a tracking frame closes the last" if closed else "")
    if steps < 1:
        raise RequestError(f"{request.source}: has {len(names)} frames, and a period of {request.period} has {needed}")
    step = FrameRange.parse(request.frames or "0", "--frames")
    last = step.first + step.step * (steps * length + closed - 1)
    raise RequestError(f"{request.source}: ends within a period, after {len(names)} frames: a period of {request.period} has {needed}: "
                       f"use the {steps} whole periods, --frames {step.first}-{last}{f':{step.step}' if step.step > 1 else ''}, or check "
                       "the plan")


def _blocks(frames: _Frames, space: ColorSpaceName) -> np.ndarray:
    """Return the means of blocks of each image, [frames, blocks], and refuse images of several sizes."""
    resolution = image_resolution(frames.folder / frames.names[0])

    def look(name: str) -> np.ndarray:
        pixels = images.read_pixels(frames.folder / name)
        if pixels.shape[1::-1] != resolution:
            raise RequestError(f"{frames.folder / name}: has {pixels.shape[1]}x{pixels.shape[0]} pixels, {frames.names[0]} "
                               f"{resolution[0]}x{resolution[1]}: frames of one camera have one size")
        return sample_of(pixels, (0, 0), space, 1.0).blocks

    with ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="relit-import") as pool:
        return np.stack(list(pool.map(look, frames.names)))


def repetition_fault(
    blocks: np.ndarray,  # [frames, blocks] float, linear, the means of blocks of each frame
    period: Sequence[Shot],  # the shots of one period, whose first is that of the first frame
    names: Sequence[str],  # of the frames
) -> str | None:
    """Return a sentence that says where frames do not repeat a plan, or None."""
    return (_misplaced(blocks, len(period), names) or _tracking_elsewhere(blocks, period, names)
            or _tracking_unlike(blocks, period, names))


def _misplaced(blocks: np.ndarray, count: int, names: Sequence[str]) -> str | None:
    """Return where frames are lit as others than those a period before."""
    reach = count // MOST_APART
    for begin in range(count, len(blocks), count):
        votes: dict[int, list[int]] = {}
        for frame in range(begin, min(begin + count, len(blocks))):
            before = range(max(0, frame - count - reach), min(frame, frame - count + reach + 1))
            apart = np.linalg.norm(blocks[before.start:before.stop] - blocks[frame], axis=1)
            nearest = int(apart.argmin())
            if apart[nearest] < CLOSER * apart[frame - count - before.start]:
                votes.setdefault(frame - before[nearest], []).append(frame)
        back, frames = max(votes.items(), key=lambda vote: len(vote[1]), default=(0, []))
        if len(frames) >= max(LEAST_VOTES, count // 3):
            return (f"{names[frames[0]]}: is lit as {names[frames[0] - back]}, {back} frames before it, and a period has {count}: "
                    "a frame was lost or doubled there, or the plan is not that of these frames")
    return None


def _tracking_elsewhere(blocks: np.ndarray, period: Sequence[Shot], names: Sequence[str]) -> str | None:
    """Return where another frame than the plan says is lit by all lamps."""
    count = len(period)
    if len({shot.lamp for shot in period if shot.lamp is not None}) < LEAST_LAMPS:
        return None
    lit = np.array([period[frame % count].levels.any() for frame in range(len(blocks))])
    full = np.array([_is_full(shot) for shot in period])
    unit = blocks / np.maximum(np.linalg.norm(blocks, axis=1, keepdims=True), 1e-30)
    misfit = np.zeros(len(blocks))
    for frame in range(len(blocks)):
        first = min(max(0, frame - count // 2), max(0, len(blocks) - count))
        mean = blocks[first:first + count][lit[first:first + count]].mean(axis=0)
        misfit[frame] = 1 - unit[frame] @ mean / max(float(np.linalg.norm(mean)), 1e-30)
    places = [frame for frame in range(len(blocks)) if _is_tracking(period[frame % count])]
    for first in range(len(places) - LEAST_TRACKING + 1):
        several = np.array(places[first:first + LEAST_TRACKING])
        unlike = {by: float(np.median(misfit[several + by])) for by in range(-(count // 2), count // 2 + 1)
                  if by == 0 or (several[0] + by >= 0 and several[-1] + by < len(blocks) and not full[(several + by) % count].any())}
        best = min(unlike, key=unlike.__getitem__)
        if unlike[0] > LEAST_MISFIT and unlike[best] < FULL_PART * unlike[0]:
            frame = next((place for place in several if misfit[place + best] < FULL_PART * misfit[place]), several[0])
            return (f"{names[frame]}: should be a tracking frame, and does not look like one as others do: the first period begins with "
                    "another frame (--frames), a frame was lost or doubled, or the plan is not that of these frames")
    return None


def _tracking_unlike(blocks: np.ndarray, period: Sequence[Shot], names: Sequence[str]) -> str | None:
    """Return which tracking frame is not as bright as those of the periods around it."""
    count, worst = len(period), (1.0, 0)
    for place in (place for place, shot in enumerate(period) if _is_tracking(shot)):
        light = blocks[place::count].mean(axis=1)
        for step, own in enumerate(light):
            first = max(0, step - NEAR)
            others = np.delete(light[first:step + NEAR + 1], step - first)
            gain = max(float(own), 1e-30) / max(float(np.median(others)), 1e-30) if len(others) else 1.0
            worst = max(worst, (gain, place + step * count), key=lambda each: abs(np.log(each[0])))
    gain, frame = worst
    if 1 / ALIKE <= gain <= ALIKE:
        return None
    return (f"{names[frame]}: should be a tracking frame, and has {gain:.3g} times the light of those of the periods around it: "
            "lamps failed, or a frame was lost")


def _is_tracking(shot: Shot) -> bool:
    return shot.name.endswith(TRACKING)


def _is_full(shot: Shot) -> bool:
    """Return whether all lamps shine, in a tracking frame or the last one of gradients."""
    return isinstance(shot.light, FullLight) or (isinstance(shot.light, GradientLight) and shot.light.axis == "full")
