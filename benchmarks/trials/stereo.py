"""Two cameras under random dots: planes, balls and rectangles at random, with calibrations that are right, and that are not."""

import json
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from benchmarks.trials.trial import Trial
from service.depth.depth import depth
from service.requests.depth import DepthRequest
from stage.errors import StageError
from stage.results.depth_maps import DepthMaps
from tests.scenes import stereo as scenes
from tests.scenes.projected import Ball, Shape, Wall, rectangle
from tests.scenes.stereo import OTHER, POSE

SCENES = 3
"""Random scenes whose pixels a row counts together."""
Change = Callable[[dict[str, Any]], dict[str, Any]]


def trials(_data: Path | None) -> Iterator[Trial]:
    """Yield what `relit depth` says of each capture."""
    yield _run("stereo, one frame", in_model=True)
    yield _run("stereo, four frames", in_model=True, frames=4)
    yield _run("stereo, a tenth of the light", in_model=True, gain=0.1)
    yield _run("stereo, the other camera out of focus by 1.2 px", in_model=False, blur=1.2)
    yield _run("stereo, one frame, 8 bits with a tone curve", in_model=False, curve=True)
    for name, change in (("turned by 0.05° about the vertical", _turned(0, 0.05, 0)),
                         ("turned by 0.2° about the vertical", _turned(0, 0.2, 0)),
                         ("tilted by 0.05°", _turned(0.05, 0, 0)), ("tilted by 0.6°", _turned(0.6, 0, 0)),
                         ("rolled by 0.3°", _turned(0, 0, 0.3)),
                         ("focal length 1 % longer", lambda camera: {**camera, "focal_px": [1.01 * OTHER.focal] * 2}),
                         ("pose the other way round", lambda camera: {**camera, "camera_from_other": np.linalg.inv(POSE).tolist()})):
        yield _run(f"stereo, other camera declared {name}", in_model=False, frames=2, change=change)
    for name, change in (("turned by 0.2° about the vertical", _turned(0, 0.2, 0)), ("rolled by 0.3°", _turned(0, 0, 0.3))):
        yield _run(f"stereo, other camera declared {name}, refined", in_model=False, frames=2, change=change, refined=True)
    yield _run("stereo, images mirrored", in_model=False, frames=2, mirrored=True)


def _turned(x: float, y: float, z: float) -> Change:
    """Return the change that turns a camera about its own axes, in degrees."""
    pose = np.array(POSE)
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("xyz", (x, y, z), degrees=True).as_matrix()
    return lambda camera: {**camera, "camera_from_other": pose.tolist()}


def _scene(random: np.random.Generator) -> list[Shape]:
    """Return a wall, and up to four parts before it."""
    parts: list[Shape] = [Wall((0, 0, -random.uniform(1.1, 1.5)), (random.uniform(-0.4, 0.4), random.uniform(-0.4, 0.4), 1), 0.6)]
    for _ in range(random.integers(1, 5)):
        at, far = random.uniform((-0.22, -0.16), (0.2, 0.15)), random.uniform(0.75, 1.05)
        albedo = random.uniform(0.2, 0.9)
        if random.random() < 0.5:
            parts.append(Ball((*at, -far), random.uniform(0.03, 0.13), albedo))
        else:
            wide, high = random.uniform((0.01, 0.02), (0.15, 0.2))
            parts.append(rectangle((at[0], at[0] + wide), (at[1], at[1] + high), far, albedo))
    return parts


def _run(name: str, *, in_model: bool, frames: int = 1, gain: float = 1.0, blur: float = 0.0, curve: bool = False, mirrored: bool = False,
         change: Change | None = None, refined: bool = False) -> Trial:
    """Return the errors of all pixels of the scenes."""
    found = [_solved(seed, frames=frames, gain=gain, blur=blur, curve=curve, mirrored=mirrored, change=change, refined=refined)
             for seed in range(SCENES)]
    error, sigma, confidence, solved = (np.concatenate([each[index] for each in found]) for index in range(4))
    return Trial(name, in_model, error, sigma, confidence, solved, "mm", found[0][4])


def _solved(seed: int, *, frames: int, gain: float, blur: float, curve: bool, mirrored: bool,
            change: Change | None, refined: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, str]:
    """Return error and σ in millimetres, confidence and whether it is solved, of each pixel; and what is said."""
    random = np.random.default_rng(seed)
    parts = _scene(random)
    patterns = [scenes.dots(100 * seed + index) for index in range(frames)]
    views = [scenes.render(parts, patterns, side=3), scenes.render(parts, patterns, OTHER, POSE, side=3)]
    white = gain * 0.8 / float(np.percentile(views[0].images, 99.5))
    recorded = []
    for camera, view in enumerate(views):
        images = [gaussian_filter(image, blur) if blur and camera else image for image in white * view.images]
        images = [scenes.recorded(np.clip(image, 0, 1) ** (1 / 2.2) if curve else image, random) for image in images]
        images = [257 * (image // 257) if curve else image for image in images]
        recorded.append([image[:, ::-1] for image in images] if mirrored else images)
    truth = views[0].depth[:, ::-1] if mirrored else views[0].depth
    with tempfile.TemporaryDirectory() as folder:
        capture = scenes.write_pair(Path(folder), *recorded)
        if change is not None:
            manifest = json.loads((capture / "capture.json").read_text())
            manifest["other_cameras"] = [change(camera) for camera in manifest["other_cameras"]]
            (capture / "capture.json").write_text(json.dumps(manifest))
        try:
            result = depth(DepthRequest(capture=capture, out=capture / "out", refine_projector=refined))
        except StageError as error:
            nothing = np.zeros(truth.size)
            return nothing, nothing, nothing, nothing > 0, str(error).split(": ", 1)[-1]
    maps = result.maps
    assert isinstance(maps, DepthMaps) and maps.sigma is not None and maps.confidence is not None
    return (1e3 * np.abs(maps.depth - truth).ravel(), 1e3 * maps.sigma.ravel(), maps.confidence.ravel(), maps.mask.ravel(),
            "; ".join(result.warnings))
