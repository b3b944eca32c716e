"""Wrong manifests, and right ones for comparison: mirrored and exchanged axes, lights behind, missing brightness, wrong encoding and order.

The scene, a ring on a knobbly ball, is sphere-traced here with cast shadows, a highlight and noise, and shares nothing with the
renderers of the tests. With a data folder, the same mistakes are made with the real lights of the DiLiGenT cat and the UW cat's
twelve frontal ones (whose truth is the solution of the right manifest, and so only bounds the error).
"""

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy import angles_deg
from benchmarks.trials.trial import Trial
from service.requests.solve import LightsKnown, Method, SolveRequest
from service.solve.solve import SolveResult, solve
from stage.formats import exr
from stage.importers import diligent
from tests.reference.colour import linear_to_srgb

SIZE, LIGHTS, STEPS = 96, 20, 64
NOISE = 0.004
"""Standard deviation of the noise, of full scale."""

Manifest = dict[str, Any]
Change = Callable[[Manifest], None]


def distance(p: np.ndarray) -> np.ndarray:
    """Return the signed distance of points [n, 3] to a knobbly ball with a tilted ring around it, scaled so that a step is safe."""
    radius = np.linalg.norm(p, axis=1)
    ball = radius - 0.62 - 0.05 * np.sin(7 * p[:, 0] + 1) * np.sin(6 * p[:, 1]) * np.cos(5 * p[:, 2])
    axis = np.array([0.45, 0.75, 0.5]) / np.linalg.norm([0.45, 0.75, 0.5])
    along = p @ axis
    ring = np.hypot(np.sqrt(np.maximum(radius**2 - along**2, 0)) - 0.72, along) - 0.16
    return np.asarray(0.7 * np.minimum(ball, ring))


def march(start: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the way to the surface along rays, [n]; infinite where they miss it."""
    way = np.zeros(len(start))
    for _ in range(STEPS):
        way += distance(start + way[:, None] * direction)
    near = np.abs(distance(start + way[:, None] * direction)) < 0.01
    return np.where(near & (way > 0) & (way < 4), way, np.inf)


def render() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return images [lights, rows, cols], directions, strengths [lights], normals [rows, cols, 3] and mask."""
    random = np.random.default_rng(31)
    across = (np.arange(SIZE) + 0.5) / SIZE * 2.1 - 1.05
    x, y = (plane.ravel() for plane in np.meshgrid(across, -across))
    start, toward = np.stack([x, y, np.full_like(x, 2.0)], axis=1), np.tile([0.0, 0.0, -1.0], (x.size, 1))
    way = march(start, toward)
    mask = np.isfinite(way)
    point = start[mask] + way[mask, None] * toward[mask]
    steps = 1e-4 * np.eye(3)
    normal = np.stack([distance(point + step) - distance(point - step) for step in steps], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    turn, tilt = random.uniform(0, 2 * np.pi, LIGHTS), np.radians(random.uniform(8, 62, LIGHTS))
    directions = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=1)
    strengths = random.uniform(0.4, 1.6, LIGHTS)
    albedo = 0.35 + 0.25 * np.sign(np.sin(9 * point[:, 0]) * np.sin(8 * point[:, 1] + 1))
    images, toward_viewer = np.zeros((LIGHTS, x.size)), np.array([0.0, 0.0, 1.0])
    for image, light, strength in zip(images, directions, strengths, strict=True):
        lit = ~np.isfinite(march(point + 0.03 * normal, np.tile(light, (len(point), 1))))
        half = (light + toward_viewer) / np.linalg.norm(light + toward_viewer)
        shade = albedo / np.pi * np.maximum(normal @ light, 0) + 0.15 * np.maximum(normal @ half, 0) ** 40
        image[mask] = strength * shade * lit * (normal @ light > 0)
    images /= images.max()
    images = np.clip(images + random.normal(0, NOISE, images.shape), 0, 1)
    normals = np.zeros((x.size, 3))
    normals[mask] = normal
    return (images.reshape(LIGHTS, SIZE, SIZE), directions, strengths, normals.reshape(SIZE, SIZE, 3), mask.reshape(SIZE, SIZE))


def turned(matrix: np.ndarray) -> Change:
    """Return the mistake of multiplying every direction by a matrix."""
    def change(manifest: Manifest) -> None:
        for light in lights(manifest):
            light["direction"] = (matrix @ np.array(light["direction"])).tolist()

    return change


def lights(manifest: Manifest) -> list[dict[str, Any]]:
    """Return the lights of a manifest."""
    return [frame["light"] for frame in manifest["frames"]]


def reordered(order: Callable[[int], np.ndarray]) -> Change:
    """Return the mistake of giving the lights in another order."""
    def change(manifest: Manifest) -> None:
        given = lights(manifest)
        for frame, number in zip(manifest["frames"], order(len(given)), strict=True):
            frame["light"] = given[number]

    return change


def alike(manifest: Manifest) -> None:
    """Declare all lights alike."""
    for light in lights(manifest):
        light["irradiance"] = [1, 1, 1]


def behind(manifest: Manifest) -> None:
    """Put every light behind the object."""
    for light in lights(manifest):
        light["direction"][2] *= -1


WRONG: dict[str, Change] = {
    "y mirrored": turned(np.diag([1, -1, 1])),
    "x mirrored": turned(np.diag([-1, 1, 1])),
    "x and y mirrored": turned(np.diag([-1, -1, 1])),
    "y and z exchanged": turned(np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0]])),
    "a quarter turn": turned(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])),
    "all behind": behind,
    "irradiance missing": alike,
    "reverse order": reordered(lambda count: np.arange(count)[::-1]),
    "shuffled": reordered(lambda count: np.random.default_rng(3).permutation(count)),
}


def trial(name: str, folder: Path, truth: np.ndarray | None, mask: np.ndarray | None, *, in_model: bool,
          method: Method = Method.ROBUST, lights: LightsKnown = LightsKnown.DECLARED) -> tuple[Trial, SolveResult]:
    """Solve a capture, and compare it with true normals (None: with nothing)."""
    result = solve(SolveRequest(capture=folder, out=folder / "out", method=method, lights=lights, device="cpu"))
    maps = result.maps
    assert maps.normal is not None and maps.sigma is not None and maps.confidence is not None
    known = maps.mask if mask is None else mask
    error = angles_deg(maps.normal, maps.normal if truth is None else truth)
    return Trial(f"{name}, {method}", in_model, error[known], maps.sigma[known].astype(np.float64),
                 maps.confidence[known].astype(np.float64), maps.mask[known], "°", " ".join(result.warnings)), result


def changed(folder: Path, change: Change) -> None:
    """Make a mistake in a written manifest."""
    path = folder / "capture.json"
    manifest = json.loads(path.read_text())
    change(manifest)
    path.write_text(json.dumps(manifest))


def write_grey(path: Path, image: np.ndarray) -> None:
    """Write [rows, cols] values as an EXR of three equal channels."""
    exr.write(path, {channel: image.astype(np.float32) for channel in "RGB"}, color_space="lin_rec709_scene", metadata={})


def mistakes(folder: Path, name: str, truth: np.ndarray, mask: np.ndarray) -> Iterator[Trial]:
    """Yield a trial for each mistake in the manifest of a capture; where its lights are alike, none for missing irradiance."""
    right = (folder / "capture.json").read_text()
    for mistake, change in WRONG.items():
        changed(folder, change)
        if json.loads(right) == json.loads((folder / "capture.json").read_text()):
            continue
        yield trial(f"{name}, {mistake}", folder, truth, mask, in_model=False)[0]
        (folder / "capture.json").write_text(right)


def trials(data: Path | None) -> Iterator[Trial]:
    """Yield the traced scene with a right manifest and with every mistake, and the real objects of a data folder."""
    images, directions, strengths, normal, mask = render()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frames = []
        for number, (image, direction, strength) in enumerate(zip(images, directions, strengths, strict=True)):
            write_grey(folder / f"{number:02d}.exr", image)
            frames.append({"image": f"{number:02d}.exr", "light": {"type": "distant", "direction": direction.tolist(),
                                                                   "irradiance": [strength] * 3}})
        write_grey(folder / "mask.exr", mask)
        manifest = {"schema": "relit.capture/1", "name": "ring", "mask": "mask.exr", "frames": frames,
                    "camera": {"projection": "orthographic", "resolution": [SIZE, SIZE]}}
        (folder / "capture.json").write_text(json.dumps(manifest))
        for method in (Method.LAMBERT, Method.ROBUST):
            yield trial("ring", folder, normal, mask, in_model=True, method=method)[0]
        yield from mistakes(folder, "ring", normal, mask)
        changed(folder, lambda given: given.update(color_space="srgb_texture"))
        yield trial("ring, linear declared sRGB", folder, normal, mask, in_model=False)[0]
        (folder / "capture.json").write_text(json.dumps(manifest))
        for number, image in enumerate(images):
            write_grey(folder / f"{number:02d}.exr", linear_to_srgb(image))
        yield trial("ring, sRGB declared linear", folder, normal, mask, in_model=False)[0]
    if data is None:
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "cat"
        diligent.import_folder(data / "diligent_cat", folder)
        truth = np.load(data / "diligent_cat" / "normal_gt.npz")["normal"]
        mask = np.linalg.norm(truth, axis=-1) > 0.5
        yield trial("DiLiGenT cat", folder, truth, mask, in_model=True)[0]
        yield from mistakes(folder, "DiLiGenT cat", truth, mask)
    if (data / "uw_cat").is_dir():
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name) / "uw"
            shutil.copytree(data / "uw_cat", folder)
            _, right = trial("UW cat", folder, None, None, in_model=True)
            assert right.maps.normal is not None
            yield from mistakes(folder, "UW cat", right.maps.normal, right.maps.mask)
