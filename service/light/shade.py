"""Solved maps and lights → a picture: near lights, area lights and an environment, with the shadows that the height throws."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels import device as devices
from kernels.relight.environment import Weighting
from kernels.relight.shading import shade as shade_surface
from kernels.relight.sources import join
from service.errors import RequestError
from service.light.combine import linear_frames
from service.light.environments import Environments
from service.light.frames import check_folders, refuse_inputs
from service.light.guide import make_guide
from service.light.layers import read_maps, still_layers
from service.light.model_light import LightModel
from service.light.near_light import NearLight, near_lights
from service.light.schedule import UPRIGHT, FrameLighting, Sky
from service.light.sequence import capture_files
from service.light.surface_model import SurfaceModel
from service.light.weights import frame_weights
from service.light.write import FrameFile, FrameFormat, FrameWriter
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import metadata
from service.requests.picture import Layer
from service.requests.shade import ShadeRequest
from stage.capture import Capture
from stage.colour import rgb_matrix
from stage.errors import ResultError
from stage.frames import fibonacci_sphere, rotation_about_y
from stage.ingest import open_stack
from stage.lighting import lights_from_centre
from stage.maps import MAPS_FILE, SurfaceMaps
from stage.point_lights import DistantLights

SHADOW_DIRECTIONS = 64
"""Directions in which shadows of even light are marched, where no captured lights say which; between them they are mixed."""


class ShadeResult(NamedTuple):
    """What was made."""

    path: Path
    metric: bool
    """Places of lights are metres; else pixels, because the maps have no scale."""
    clipped: int
    """Pixels above the largest half value, stored as that value."""


def shade(request: ShadeRequest, progress: Progress | None = None) -> ShadeResult:
    """Light solved maps.

    Args:
        request: maps, lights and where the picture goes.
        progress: told of every stage.

    Raises:
        RequestError: no light, a file that is no .exr, or one that would replace an input.
        StageError, KernelError: bad input; names file and field.
        StorageError: the picture cannot be written; nothing is left half-written.
    """
    timings = Timings(progress)
    device = devices.resolve(request.device)
    near: tuple[NearLight, ...] = (*request.light, *request.sphere, *request.rectangle)
    timings.stage("open", 1)
    path = check(request)
    environments = Environments(request.environment) if request.environment is not None else None
    sky = None
    if environments is not None:
        sky = Sky(environments.path(1), request.turn_degrees, UPRIGHT, rotation_about_y(request.turn_degrees), 0.0)
    lighting = FrameLighting(1, sky, (), {}, request.exposure)
    if request.capture is None:
        maps = SurfaceMaps.read(path)
        frame, shine = _of_maps(maps, path, lighting, environments, near, device, timings)
    else:
        capture = Capture.open(request.capture)
        maps = read_maps(path, capture)
        frame, shine = _of_capture(capture, request.cache, maps, path, lighting, environments, near, device, timings)
    timings.stage("write", 1)
    layers = still_layers(request.aov, None, maps, path)
    space = str(request.color_space or maps.color_space)
    parts = tuple(layer for layer in (Layer.DIFFUSE, Layer.SPECULAR) if layer in request.aov)
    form = FrameFormat(maps.camera.resolution, space, None if space == maps.color_space else rgb_matrix(maps.color_space, space),
                       request.compression, layers, parts)
    facts = metadata(request, capture=maps.provenance.get("relit:capture", ""), inputs=maps.provenance.get("relit:inputs", ""))
    with FrameWriter(lambda _: timings.advance(1)) as writer:
        writer.put([FrameFile(request.out, 2.0**request.exposure, facts)], frame[None], form, shine[None] if parts else None)
    timings.close()
    return ShadeResult(request.out, maps.camera.metric, writer.written.clipped)


def check(request: ShadeRequest) -> Path:
    """Refuse what cannot be, as far as that is cheap; nothing is written.

    Returns:
        The file of the maps.

    Raises:
        RequestError: no light, a file that is no .exr, or one that would replace an input.
        StageError: maps, capture or folder are not there; names them.
    """
    if not (request.light or request.sphere or request.rectangle) and request.environment is None:
        raise RequestError("there is no light: give --light, --sphere, --rectangle or --environment")
    if request.out.suffix.lower() != ".exr":
        raise RequestError(f"--out {request.out}: pictures are OpenEXR: end the name in .exr")
    path = request.maps / MAPS_FILE if request.maps.is_dir() else request.maps
    if not path.is_file():
        raise ResultError(f"{path}: is not there: run `relit solve` first")
    refuse_inputs([(f"--out {request.out}", request.out)], [path, *([request.environment] if request.environment else []),
                                                            *(capture_files(request.capture) if request.capture else ())])
    check_folders([request.out])
    if request.environment is not None:
        Environments(request.environment).check([1])
    return path


def _of_maps(maps: SurfaceMaps, path: Path, lighting: FrameLighting, environments: Environments | None, near: tuple[NearLight, ...],
             device: str, timings: Timings) -> tuple[np.ndarray, np.ndarray]:
    """[3, pixels] float32 of the maps alone, and the specular part of it."""
    model = SurfaceModel(maps, path, device)
    around = DistantLights(fibonacci_sphere(SHADOW_DIRECTIONS), np.zeros((SHADOW_DIRECTIONS, 3)))
    far = LightModel(around, environments, maps.color_space).light(lighting, around.irradiance)
    places = [np.concatenate([around.direction, np.zeros((SHADOW_DIRECTIONS, 1))], axis=1)] if far.wanted.count else []
    places.append(far.marched)
    close = near_lights(near, sum(map(len, places)))
    rows, light = np.concatenate([*places, close.marched]), join([far.wanted, close.fine])
    frame, shine = (np.zeros((3, maps.mask.size), dtype=np.float32) for _ in range(2))
    timings.stage("shade", len(model.pixels))
    done = 0
    for batch in model.batches():
        lit = shade_surface(batch.surface, light, model.see(rows, batch.pixels)).numpy()[:, : len(batch.pixels)]
        frame[:, batch.pixels], shine[:, batch.pixels] = lit[:3] + lit[3:], lit[3:]
        done += len(batch.pixels)
        timings.advance(done)
    return frame, shine


def _of_capture(capture: Capture, cache: Path | None, maps: SurfaceMaps, path: Path, lighting: FrameLighting,
                environments: Environments | None, near: tuple[NearLight, ...], device: str,
                timings: Timings) -> tuple[np.ndarray, np.ndarray]:
    """[3, pixels] float32 of the captured images, guided by the maps, and the specular part of it."""
    lights = lights_from_centre(capture)
    timings.stage("ingest", len(capture.sources()))
    stack = open_stack(capture, cache=cache, progress=lambda done, _: timings.advance(done))
    guide = make_guide(maps, path, stack, lights, environments, maps.color_space, device, timings)
    timings.stage("shade", 2)
    weights = np.stack(list(frame_weights([lighting], environments, lights, stack, maps.color_space, weighting=Weighting.SMOOTH,
                                          device=device)))
    frames = linear_frames(stack, weights, None, device=device)
    shine = guide.correct(frames, [lighting], weights, specular=True)
    assert shine is not None
    timings.advance(1)
    guide.add_near(frames[0], shine[0], near)
    timings.advance(2)
    return frames[0], shine[0]
