"""A performance: frames of a moving subject under lights that repeat a plan, cut into a sequence of captures, one a period."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.acquisition.acquire import NO_LAMPS
from service.acquisition.capture_files import CaptureFiles
from service.acquisition.checks.repetition import repetition_fault
from service.acquisition.checks.sample import sample_of
from service.acquisition.plans.plan import read_plan
from service.acquisition.plans.shots import FLAT, TRACKING, Shot, shots_of
from service.errors import RequestError
from service.requests.imports.interleaved import InterleavedImport
from stage.capture.sequence import FRAME_RATE, SEQUENCE_FILE, TimeStep, write_sequence
from stage.capture.sequence import Sequence as CaptureSequence
from stage.colour.colour_spaces import ColorSpaceName
from stage.files import folder_beside, replacing_folder
from stage.formats import images
from stage.importers.camera_options import Selection, select
from stage.importers.layout import Imported, color_space_of, image_resolution, place_images
from stage.importers.video import FrameRange, is_video, unpack
from stage.rig.rig import read_rig


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

    Raises:
        RequestError: the plan cannot repeat, or the frames do not repeat it; names what does not fit.
        StageError: plan, rig, an image or the video is wrong, or the folder cannot be written.
    """
    target = request.destination
    if target is None:
        raise RequestError("DST is missing: give a folder for the sequence behind SRC")
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise RequestError(f"{target}: is there already: give another folder for the sequence")
    rig = NO_LAMPS if request.rig is None else read_rig(request.rig)
    shots = shots_of(read_plan(request.period), rig, request.projector)
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
    """Return the number of periods."""
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
