"""Relight captures: each frame is the linear combination of the captured images, guided by solved maps where they are given.

Source: light is additive, so that images under single lights sum to an image under any light that they span; Debevec et al.,
"Acquiring the Reflectance Field of a Human Face", SIGGRAPH 2000, section 3.
"""

from collections.abc import Mapping, Sequence
from itertools import groupby, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels import device as devices
from kernels.images import ImagesOnDevice
from service.light_estimation.declared_lights import declared_light_sentences
from service.relight.attributes import time_attributes
from service.relight.clipping import Clipping
from service.relight.combine import chunk_frames, linear_frames, row_blocks
from service.relight.findings import FrameFindings, MatteFindings, dim_sentences
from service.relight.guide import Guide
from service.relight.layers import frame_matte, read_maps, still_layers
from service.relight.lighting import CaptureLighting, FrameLight, ModelUse
from service.relight.nuke import write_nuke_script
from service.relight.opened_capture import OpenedCapture, open_capture
from service.relight.outputs import REQUEST_ATTRIBUTE, display_path, frame_hashes, is_complete
from service.relight.plan import Plan, PlannedFrame, add_up, in_groups, make_plan
from service.relight.sheet import contact_sheet, display_frame
from service.relight.write import FrameFile, FrameFormat, FrameWriter
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import metadata, other_manifest, report
from service.requests.light.picture_options import Layer
from service.requests.relight import CHUNK_FRAMES, RelightRequest
from stage.files import write_text
from stage.stack.brackets import merge_brackets
from stage.stack.stack import Stack

ROW_CHUNK_FRAMES = 64
"""Most frames of a chunk that is made some rows at a time: large images are read from the disk once for each chunk."""
MODEL_CHUNK_FRAMES = 128
"""Most frames of a chunk that a model guides: its responses to light are computed once for all of them."""
RANGE_FRAMES = 4
"""Least number of frames of a chunk whose model is computed once for all of them; for fewer, each frame is shaded with its own samples."""


class RelightResult(NamedTuple):
    """Files and counts of a relight."""

    frames: tuple[Path, ...]
    """The files of the range, or of the part of it that was asked for, in order."""
    captures: int
    """Number of captures: more than one in a sequence."""
    skipped: int
    """Number of frames that an equal request had made already."""
    clipped: int
    """Pixels of the frames made now that are beyond the largest half value, stored as that value."""
    near_lights: int
    """Point lights that were taken as distant ones, as the object's centre sees them; in a sequence the largest number of one capture."""
    matte: str
    """A sentence that names the source of the coverage of partly covered pixels; empty where there is nothing to say."""
    warnings: tuple[str, ...]
    """Sentences that say what does not fit in the frames made now, and what to try."""


def relight(request: RelightRequest, progress: Progress | None = None) -> RelightResult:
    """Relight a capture, or a sequence of captures with one frame each.

    Raises:
        RequestError: a bad frame range, a pattern without ####, options that do not fit, or a frame that would replace an input.
        StorageError: a frame cannot be written; frames already there are whole.
    """
    timings = Timings(progress)
    device = devices.resolve(request.device)
    request = request.model_copy(update={"weights": request.used_weights})  # which is recorded
    timings.stage("open", 1)
    plan = make_plan(request)
    skipped = near_lights = 0
    captures: list[dict[str, object]] = []
    findings, mattes = FrameFindings(guided=request.maps is not None), MatteFindings()
    if plan.is_sequence:
        timings.stage("frames", len(plan.frames))
    with FrameWriter(lambda written: timings.advance(skipped + written)) as writer:
        for folder, frames in plan.captures():
            with timings.part("open"):
                scheduled = [frame.scheduled for frame in frames]
                opened = open_capture(folder, request, len(plan.folders), scheduled)
                hashes = frame_hashes(opened, request, scheduled, plan.environments, plan.rate)
                todo = [(frame, request_hash) for frame, request_hash in zip(frames, hashes, strict=True)
                        if request.overwrite or not is_complete(frame.path, request_hash)]
            near_lights = max(near_lights, opened.near_lights)
            skipped += len(frames) - len(todo)
            captures.append({"name": opened.capture.name, "content": opened.ingest.key, "frames": len(opened.lights.direction)})
            if todo:
                _relight_capture(opened, todo, request, plan, writer, findings, mattes, device, timings)
                findings.negative |= opened.capture.clipped
                for doubt in opened.capture.doubts:
                    findings.add_doubt(doubt)
        with timings.part("waiting for files"):
            writer.wait()
        if plan.is_sequence:
            timings.advance(skipped + writer.written.frames)
    if plan.environments is not None:
        findings.negative |= plan.environments.clipped or {}
        findings.doubts += plan.environments.doubts()
    paths = tuple(frame.path for frame in plan.frames)
    if request.display is not None:
        timings.stage("display", len(paths))
        for done, frame in enumerate(plan.frames, start=1):
            display_frame(display_path(request.display, frame.scheduled.number), frame.path, request.review)
            timings.advance(done)
    if request.sheet is not None:
        timings.stage("sheet", 1)
        contact_sheet(request.sheet, paths, request.review)
    if request.nuke is not None:
        numbered = [(frame.scheduled.number, frame.path) for frame in plan.frames]
        write_nuke_script(request.nuke, request.out, numbered, plan.groups, plan.rate)
    timings.close()
    result = RelightResult(paths, len(plan.folders), skipped, writer.written.clipped, near_lights, mattes.sentence,
                           (*findings.sentences, *dim_sentences(writer.written.peak)))
    if request.report is not None:
        write_text(request.report, report(
            request,
            inputs={"capture": str(request.capture), "captures": captures},
            frames={"made": writer.written.frames, "skipped": skipped, "clipped_pixels": writer.written.clipped,
                    "first": str(paths[0]), "last": str(paths[-1])},
            matte=mattes.counts,
            warnings=result.warnings,
            device=devices.describe(device),
            timings_s={**timings.seconds, "of these": {name: round(seconds, 3) for name, seconds in timings.parts.items()},
                       "on writing threads": {"to half": round(writer.written.half_s, 3), "files": round(writer.written.file_s, 3)}}))
    return result


def _relight_capture(opened: OpenedCapture, todo: list[tuple[PlannedFrame, str]], request: RelightRequest, plan: Plan,
                     writer: FrameWriter, findings: FrameFindings, mattes: MatteFindings, device: str, timings: Timings) -> None:
    """Make frames of one capture; `todo` holds each frame with the hash of its request."""
    maps = None if opened.maps is None else read_maps(opened.maps, opened.capture)
    written = request.color_space or opened.space
    layers = still_layers(request.aov, opened.capture, maps, opened.maps, written)
    environment = todo[0][0].scheduled.environment
    if environment is not None and plan.environments is not None:
        plan.environments.read(environment.path, opened.space)  # a bad environment map is known before the images are read
    if not plan.is_sequence:
        timings.stage("ingest", len(opened.capture.sources()))
    with timings.part("ingest"):
        stack = merge_brackets(opened.ingest.stack(None if plan.is_sequence else lambda done, _: timings.advance(done)),
                               opened.capture.sources(), opened.lights)
        mask = opened.capture.mask()
        clipping = Clipping.of(stack, mask.reshape(-1))
        for sentence in declared_light_sentences(stack, opened.capture, opened.lights, mask):
            findings.add_field(sentence)
    with timings.part("matte"):
        matte = frame_matte(request, opened.capture, stack)
        mattes.add(matte)
    guide, images = None, None
    if maps is not None and opened.maps is not None:
        with timings.part("guide"):
            guide = Guide(maps, opened.maps, stack, opened.lights, clipping, space=opened.space, device=device,
                          progress=None if plan.is_sequence else timings)
            images = guide.images
            stack = images.stack
        findings.add_doubt(guide.doubt)
        findings.add_doubt(other_manifest(maps.camera, maps.provenance, opened.capture, opened.maps))
    images = images or ImagesOnDevice(stack, device)
    if not plan.is_sequence:
        timings.stage("frames", len(plan.frames))
    form = FrameFormat.of(request, opened.capture.camera, opened.space, written, layers, matte)
    provenance = metadata(request, capture=opened.capture.name, inputs=stack.key, near_lights=opened.near_lights)
    if plan.keys is not None and plan.keys.frames_per_second is not None:
        provenance["relit:frames_per_second"] = f"{plan.keys.frames_per_second:g}"
    alone = plan.total == 1 or plan.is_sequence  # decided from the whole range, so that --only gives bit-identical frames
    in_rows = guide is None and not alone and chunk_frames(stack) < CHUNK_FRAMES  # a model looks at whole frames
    whole = chunk_frames(stack) if guide is None else chunk_frames(stack, MODEL_CHUNK_FRAMES, guided_on=device)
    size = max(1, (ROW_CHUNK_FRAMES if in_rows else whole) // max(1, len(plan.groups)))
    use = ModelUse.NONE if guide is None else ModelUse.FRAME if alone or size < RANGE_FRAMES else ModelUse.RANGE
    lighting = CaptureLighting(opened.lights, stack, plan.environments, opened.space, weighting=request.used_weights,
                               device=device, model=use)
    lights = lighting.frames([frame.scheduled for frame, _ in todo])
    single = [in_groups(frame.scheduled, plan.keys) for frame, _ in todo] if len(plan.groups) > 1 else []
    single_lights = [lighting.frames(frames) for frames in zip(*single, strict=True)]
    for _, members in groupby(todo, key=lambda item: item[0].position // size):
        chunk = list(members)
        with timings.part("weights"):
            light = list(islice(lights, len(chunk)))
        weights, numbers = np.stack([each.weights for each in light]), [frame.scheduled.number for frame, _ in chunk]
        findings.add_beyond(numbers, [each.share_beyond for each in light], lighting.beyond_degrees)
        findings.add_clipped(numbers, weights, clipping)
        places = None if alone else [frame.position % size for frame, _ in chunk]
        files = [FrameFile(frame.path, 2.0**frame.scheduled.exposure_stops,
                           {**provenance, **frame.scheduled.metadata, **time_attributes(frame.scheduled.number, plan.rate),
                            REQUEST_ATTRIBUTE: request_hash}) for frame, request_hash in chunk]
        groups = dict.fromkeys(plan.groups, light)  # a single one is the light of the frame
        for name, each in zip(plan.groups, single_lights, strict=False):
            groups[name] = list(islice(each, len(chunk)))
        if in_rows:
            _write_rows(files, form, weights, images, places, groups, writer, timings)
            continue
        colours: dict[str, np.ndarray] = {}
        halves = not groups and form.as_computed(files)
        if guide is None:
            with timings.part("product"):
                frames = linear_frames(images, weights, places, halves=halves)
        else:
            with timings.part("guide"):
                frames, specular = _guided(guide, light, places, specular=bool(form.parts), halves=halves)
            if specular is not None:
                colours[Layer.SPECULAR] = specular
        if groups:
            with timings.part("single lights"):
                colours |= _lights_alone(groups, frames, images, places, guide)
        with timings.part("waiting for files"):
            writer.put(files, frames, form, colours)


def _write_rows(files: Sequence[FrameFile], form: FrameFormat, weights: np.ndarray, images: ImagesOnDevice[Stack],
                places: Sequence[int] | None, groups: Mapping[str, Sequence[FrameLight]], writer: FrameWriter, timings: Timings) -> None:
    """Make the frames of a chunk without a model, some rows of all of them at a time: the images are read once for the whole chunk."""
    with writer.in_rows(files, form) as put:
        for block in row_blocks(images.stack, form.resolution[0], len(files) * (1 + len(groups))):
            with timings.part("product"):
                frames = linear_frames(images, weights, places, pixels=block.pixels, halves=not groups and form.as_computed(files))
            with timings.part("single lights"):
                colours = _lights_alone(groups, frames, images, places, None, block.pixels)
            with timings.part("waiting for files"):
                put(block.first, block.last, frames, colours)


def _guided(guide: Guide, lights: Sequence[FrameLight], places: Sequence[int] | None, *,
            specular: bool, halves: bool = False) -> tuple[np.ndarray, np.ndarray | None]:
    """Return frames with what the model says that plain ones miss, and their specular part where it is wanted.
    `halves`: whether frames of a range from CUDA are half."""
    weights = np.stack([each.weights for each in lights])
    of_range = [each.spread for each in lights if each.spread is not None]
    if of_range and places is not None and guide.images.device != "cpu":
        return guide.frames_on_device(weights, of_range, places, specular=specular, halves=halves)
    frames = linear_frames(guide.images, weights, places)
    if of_range and places is not None:
        return frames, guide.correct_range(frames, of_range, places, specular=specular)
    return frames, guide.correct(frames, [each.model for each in lights if each.model is not None], specular=specular)


def _lights_alone(groups: Mapping[str, Sequence[FrameLight]], frames: np.ndarray, images: ImagesOnDevice[Stack],
                  places: Sequence[int] | None, guide: Guide | None, pixels: slice | None = None) -> dict[str, np.ndarray]:
    """Return the frames under each light alone, which add up to the frames [frames, 3, pixels], by the names of their layers."""
    if len(groups) == 1:
        return {name: frames.copy() for name in groups}
    found = {}
    for name, light in groups.items():
        if guide is None:
            found[name] = linear_frames(images, np.stack([each.weights for each in light]), places, pixels=pixels)
        else:
            found[name], _ = _guided(guide, light, places, specular=False)
    if guide is not None and found:
        add_up(list(found.values()), frames)
    return found
