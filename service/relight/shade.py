"""Light solved maps with near lights, area lights and an environment, with the shadows that the height throws.

The maps alone are shaded by Relit's BRDF, diffuse and GGX (kernels.relight.model.shading); with the capture, a sum of its images is
guided by that model (service.relight.guide).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels import device as devices
from kernels.relight.model.sources import join
from service.errors import RequestError
from service.relight.clipping import Clipping
from service.relight.combine import linear_frames
from service.relight.environments import Environments
from service.relight.far_light import far_light, far_samples
from service.relight.findings import FrameFindings, dim_sentences
from service.relight.guide import Guide
from service.relight.layers import check_layers, frame_matte, hard_matte, read_maps, still_layers
from service.relight.lighting import CaptureLighting, ModelUse
from service.relight.model_light import NearLight, light_samples, near_lights
from service.relight.outputs import check_outputs
from service.relight.schedule import UPRIGHT, ScheduledFrame, TurnedEnvironment
from service.relight.sheet import display_frame
from service.relight.surface_model import SurfaceModel
from service.relight.time_steps import capture_files
from service.relight.write import FrameFile, FrameFormat, FrameWriter
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import metadata, other_manifest
from service.requests.light.picture_options import FrameMatte, Layer
from service.requests.relight import LightWeights
from service.requests.shade import ShadeRequest
from stage.capture.capture import Capture
from stage.capture.lighting import lights_from_centre
from stage.colour.radiance import clipping_sentences
from stage.results.maps import MAPS_FILE, SurfaceMaps, capture_as_solved
from stage.results.matte import Matte
from stage.results.result_metadata import result_file
from stage.stack.brackets import merge_brackets
from stage.stack.ingest import open_stack
from stage.transforms import fibonacci_sphere, rotation_about_y

SHADOW_DIRECTIONS = 64
"""Number of directions in which the shadows of broad light are marched where there are no captured lights; between them, visibility is
interpolated."""


class ShadeResult(NamedTuple):
    """The picture that was made."""

    path: Path
    metric: bool
    """True where places of lights are metres; else they are pixels, because the maps have no scale."""
    clipped: int
    """Pixels above the largest half value, stored as that value."""
    warnings: tuple[str, ...]
    """Sentences that say what does not fit, and what to try."""


def shade(request: ShadeRequest, progress: Progress | None = None) -> ShadeResult:
    """Light solved maps, and write the picture whole or not at all.
    Raises RequestError: no light, a file that is no .exr, or one that would replace an input."""
    timings = Timings(progress)
    device = devices.resolve(request.device)
    near: tuple[NearLight, ...] = (*request.light, *request.sphere, *request.rectangle)
    timings.stage("open", 1)
    path = check(request)
    environments = None if request.environment is None else Environments(request.environment, clip_negative=request.clip_negative)
    environment = None
    if environments is not None:
        turn = request.turn_degrees
        environment = TurnedEnvironment(environments.path(1), turn, UPRIGHT, rotation_about_y(turn), 0.0)
    lighting = ScheduledFrame(1, environment, (), {}, request.exposure)
    capture = None if request.capture is None else capture_as_solved(Capture.open(request.capture, request.pixels), path)
    if capture is None:
        maps = SurfaceMaps.read(path)
        frame, specular, warnings = _shade_maps(maps, path, lighting, environments, near, device, timings)
        matte = None if request.matte is FrameMatte.NONE else hard_matte(maps.mask)
    else:
        maps = read_maps(path, capture)
        frame, specular, matte, warnings = _shade_capture(capture, request, maps, path, lighting, environments, near, device, timings)
    timings.stage("write", 1)
    written = request.color_space or maps.color_space
    form = FrameFormat.of(request, maps.camera, maps.color_space, written, still_layers(request.aov, None, maps, path, written), matte)
    facts = metadata(request, capture=maps.provenance.get("relit:capture", ""), inputs=maps.provenance.get("relit:inputs", ""))
    with FrameWriter(lambda _: timings.advance(1)) as writer:
        writer.put([FrameFile(request.out, 2.0**request.exposure, facts)], frame[None], form,
                   {Layer.SPECULAR: specular[None]} if form.parts else {})
    if request.display is not None:
        display_frame(request.display, request.out, request.review)
    timings.close()
    negative = {**({} if environments is None else environments.clipped or {}), **({} if capture is None else capture.clipped)}
    doubts = [] if environments is None else environments.doubts()
    return ShadeResult(request.out, maps.camera.metric, writer.written.clipped, (*warnings, *doubts, *clipping_sentences(negative),
                                                                                       *dim_sentences(writer.written.peak)))


def check(request: ShadeRequest) -> Path:
    """Check a request as far as that is cheap, and return the file of the maps.
    Raises RequestError: no light, a file that is no .exr or would replace an input, or layers that cannot be written."""
    if not (request.light or request.sphere or request.rectangle) and request.environment is None:
        raise RequestError("there is no light: give --light, --sphere, --rectangle or --environment")
    if request.out.suffix.lower() != ".exr":
        raise RequestError(f"--out {request.out}: pictures are OpenEXR: end the name in .exr")
    if Layer.LIGHTS in request.aov:
        raise RequestError(f"--aov {Layer.LIGHTS} is a layer of relit frames: make one picture for each light, or use `relit relight`")
    check_layers(request, request.maps)
    path = result_file(request.maps, MAPS_FILE, command="relit solve")
    request.require_picture(display=request.display)
    outputs = [(f"--out {request.out}", request.out)]
    if request.display is not None:
        if request.display.suffix.lower() != ".png":
            raise RequestError(f"--display {request.display}: is a PNG: end the name in .png")
        outputs.append((f"--display {request.display}", request.display))
    check_outputs(outputs, [path, *([request.environment] if request.environment else []),
                                                            *(capture_files(request.capture) if request.capture else ())])
    if request.environment is not None:
        Environments(request.environment).check([1])
    return path


def _shade_maps(maps: SurfaceMaps, path: Path, lighting: ScheduledFrame, environments: Environments | None, near: tuple[NearLight, ...],
                device: str, timings: Timings) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Return [3, pixels] float32 radiance of the maps alone, its specular part, and warnings."""
    model = SurfaceModel(maps, path, device)
    around = fibonacci_sphere(SHADOW_DIRECTIONS)
    wanted, marched = light_samples(far_samples(far_light(lighting, environments, maps.color_space)), around)
    places = [np.concatenate([around, np.zeros((SHADOW_DIRECTIONS, 1))], axis=1)] if wanted.count else []
    places.append(marched)
    close = near_lights(near, sum(map(len, places)), model.places(model.pixels))
    rows, light = np.concatenate([*places, close.marched]), join([wanted, close.fine])
    frame, specular = (np.zeros((3, maps.mask.size), dtype=np.float32) for _ in range(2))
    timings.stage("shade", len(model.pixels))
    for batch in model.batches():
        lit = model.lit(batch, light, model.see(rows, batch))
        frame[:, batch.pixels], specular[:, batch.pixels] = lit[:3] + lit[3:], lit[3:]
        timings.advance(batch.part.stop)
    assert maps.diffuse_albedo is not None
    usual = float(np.median(maps.diffuse_albedo.reshape(-1, 3)[model.pixels].max(axis=1)))
    bright = () if usual <= 1 else (
        f"{path}: layer diffuse_albedo is {usual:.3g} in the median, and nothing reflects more light than it gets: the picture is too "
        "bright; give albedo as 0…1 (values of 8 bits divided by 255, and decoded to linear)",)
    return frame, specular, (*close.doubts, *bright)


def _shade_capture(capture: Capture, request: ShadeRequest, maps: SurfaceMaps, path: Path, lighting: ScheduledFrame,
                   environments: Environments | None, near: tuple[NearLight, ...], device: str,
                   timings: Timings) -> tuple[np.ndarray, np.ndarray, Matte | None, tuple[str, ...]]:
    """Return [3, pixels] float32 radiance of the captured images, guided by the maps, its specular part, the matte, and warnings."""
    lights = lights_from_centre(capture)
    timings.stage("ingest", len(capture.sources()))
    stack = merge_brackets(open_stack(capture, cache=request.cache, progress=lambda done, _: timings.advance(done)), capture.sources(),
                           lights)
    matte = frame_matte(request, capture, stack)
    clipping = Clipping.of(stack, capture.mask().reshape(-1))
    guide = Guide(maps, path, stack, lights, clipping, space=maps.color_space, device=device, progress=timings)
    timings.stage("shade", 2)
    captured = CaptureLighting(lights, guide.images.stack, environments, maps.color_space, weighting=LightWeights.SMOOTH, device=device,
                               model=ModelUse.FRAME)
    light, = captured.frames([lighting])
    frames = linear_frames(guide.images, light.weights[None], None)
    findings = FrameFindings(guided=True)
    findings.add_beyond([None], [light.share_beyond], captured.beyond_degrees)
    findings.add_doubt(guide.doubt)
    findings.add_doubt(other_manifest(maps.camera, maps.provenance, capture, path))
    findings.add_clipped([None], light.weights[None], clipping)
    assert light.model is not None
    specular = guide.correct(frames, [light.model], specular=True)
    assert specular is not None
    timings.advance(1)
    close = near_lights(near, len(lights.direction), guide.places)
    guide.add_near(frames[0], specular[0], close)
    timings.advance(2)
    return frames[0], specular[0], matte, (*findings.sentences, *close.doubts)
