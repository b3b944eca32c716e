"""Captures and light → frames: the linear combination of the captured images, chunk by chunk, each frame whole or not there."""

from itertools import groupby, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels import device as devices
from kernels.relight.environment import Weighting
from service.light.combine import chunk_frames, linear_frames
from service.light.frames import REQUEST_ATTRIBUTE, is_complete
from service.light.guide import make_guide
from service.light.plan import Plan, PlannedFrame, make_plan
from service.light.sheet import contact_sheet
from service.light.step import Step, frame_hashes, open_step
from service.light.weights import frame_weights
from service.light.write import FrameFile, FrameFormat, FrameWriter
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import metadata, report
from service.requests.picture import Layer
from service.requests.relight import RelightRequest
from stage.colour import rgb_matrix
from stage.files import write_text


class RelightResult(NamedTuple):
    """What a relight made."""

    frames: tuple[Path, ...]
    """Of the range, or of the part of it that was asked for, in order."""
    captures: int
    """More than one of a sequence."""
    skipped: int
    """Frames that were there already, made by an equal request."""
    clipped: int
    """Pixels of the frames made now that are beyond the largest half value, stored as that value."""
    near_lights: int
    """Point lights that were taken as distant ones, as the object's centre sees them; of a sequence the most of one capture."""


def relight(request: RelightRequest, progress: Progress | None = None) -> RelightResult:
    """Relight a capture, or a sequence of captures with one frame each.

    Args:
        request: captures, light, frames and where to put them.
        progress: told of every stage.

    Raises:
        RequestError: a bad frame range, a pattern without ####, options that do not fit, or a frame that would replace an input.
        StageError, KernelError: bad input; names file and field.
        StorageError: a frame cannot be written; frames already there are whole.
    """
    timings = Timings(progress)
    device = devices.resolve(request.device)
    timings.stage("open", 1)
    plan = make_plan(request)
    skipped = near_lights = 0
    captures: list[dict[str, object]] = []
    if plan.is_sequence:
        timings.stage("frames", len(plan.frames))
    with FrameWriter(lambda written: timings.advance(skipped + written)) as writer:
        for folder, frames in plan.steps():
            with timings.part("open"):
                step = open_step(folder, request, len(plan.folders), [frame.lighting for frame in frames])
                hashes = frame_hashes(step, request, [frame.lighting for frame in frames], plan.environments)
                todo = [(frame, request_hash) for frame, request_hash in zip(frames, hashes, strict=True)
                        if request.overwrite or not is_complete(frame.path, request_hash)]
            near_lights = max(near_lights, step.near_lights)
            skipped += len(frames) - len(todo)
            captures.append({"name": step.capture.name, "content": step.ingest.key, "frames": len(step.lights.direction)})
            if todo:
                _relight_step(step, todo, request, plan, writer, device, timings)
        with timings.part("waiting for files"):
            writer.wait()
    paths = tuple(frame.path for frame in plan.frames)
    if request.sheet is not None:
        timings.stage("sheet", 1)
        contact_sheet(request.sheet, paths)
    timings.close()
    result = RelightResult(paths, len(plan.folders), skipped, writer.written.clipped, near_lights)
    if request.report is not None:
        write_text(request.report, report(
            inputs={"capture": str(request.capture), "captures": captures},
            options=request.model_copy(update={"weights": request.weighting}).model_dump(
                mode="json", exclude={"capture", "device", "cache", "report", "only"}),
            frames={"made": writer.written.frames, "skipped": skipped, "clipped_pixels": writer.written.clipped,
                    "first": str(paths[0]), "last": str(paths[-1])},
            device=devices.describe(device),
            timings_s={**timings.seconds, "of these": {name: round(seconds, 3) for name, seconds in timings.parts.items()},
                       "on writing threads": {"to half": round(writer.written.half_s, 3), "files": round(writer.written.file_s, 3)}}))
    return result


def _relight_step(step: Step, todo: list[tuple[PlannedFrame, str]], request: RelightRequest, plan: Plan, writer: FrameWriter,
                  device: str, timings: Timings) -> None:
    """Make frames of one capture: (frame, its request hash)."""
    maps = step.solved()
    layers = step.layers(request.aov, maps)
    sky = todo[0][0].lighting.sky
    if sky is not None and plan.environments is not None:
        plan.environments.read(sky.path, step.space)  # a bad map is known before the images are read
    if not plan.is_sequence:
        timings.stage("ingest", len(step.capture.sources()))
    with timings.part("ingest"):
        stack = step.ingest.stack(None if plan.is_sequence else lambda done, _: timings.advance(done))
    guide = None
    if maps is not None and step.maps is not None:
        with timings.part("guide"):
            guide = make_guide(maps, step.maps, stack, step.lights, plan.environments, step.space, device,
                               None if plan.is_sequence else timings)
    if not plan.is_sequence:
        timings.stage("frames", len(plan.frames))
    space = str(request.color_space or step.space)
    form = FrameFormat(step.capture.camera.resolution, space, None if space == step.space else rgb_matrix(step.space, space),
                       request.compression, layers, tuple(layer for layer in (Layer.DIFFUSE, Layer.SPECULAR) if layer in request.aov))
    provenance = metadata(request.model_copy(update={"weights": request.weighting}), capture=step.capture.name, inputs=stack.key)
    if step.near_lights:
        provenance["relit:lights"] = f"{step.near_lights} near lights taken as distant, as the object's centre sees them"
    if plan.keys is not None and plan.keys.frames_per_second is not None:
        provenance["relit:frames_per_second"] = f"{plan.keys.frames_per_second:g}"
    each_weights = frame_weights([frame.lighting for frame, _ in todo], plan.environments, step.lights, stack, step.space,
                                 weighting=Weighting(request.weighting), device=device)
    size = chunk_frames(stack)
    wants_shine = Layer.DIFFUSE in request.aov or Layer.SPECULAR in request.aov
    for _, members in groupby(todo, key=lambda item: item[0].place // size):
        chunk = list(members)
        with timings.part("weights"):
            weights = np.stack(list(islice(each_weights, len(chunk))))
        with timings.part("product"):
            alone = plan.total == 1 or plan.is_sequence  # of the whole range: a part of it is the same to the last bit
            frames = linear_frames(stack, weights, None if alone else [frame.place % size for frame, _ in chunk], device=device)
        shine = None
        if guide is not None:
            with timings.part("guide"):
                shine = guide.correct(frames, [frame.lighting for frame, _ in chunk], weights, specular=wants_shine)
        files = [FrameFile(frame.path, 2.0**frame.lighting.stops,
                           {**provenance, **frame.lighting.metadata, REQUEST_ATTRIBUTE: request_hash}) for frame, request_hash in chunk]
        with timings.part("waiting for files"):
            writer.put(files, frames, form, shine)
