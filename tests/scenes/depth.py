"""Synthetic captures for depth with a known truth: a sphere before a tilted plane under a projector or a laser, its images computed from
exact geometry in float64 and written with OpenImageIO, OpenEXR and json alone."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import shift

from service.depth.depth import DepthResult, depth
from service.depth.patterns.pattern_checks import Sample
from service.requests.depth import DepthRequest
from tests.reference import projector as reference
from tests.scenes.captures import write_images, write_manifest

CAMERA = reference.Device(96, 72, 140.0, (-0.12, 0.03, 0.0), (0.001, -0.0015))
PROJECTOR = reference.Device(128, 96, 150.0, (-0.15, 0.04, -0.01), (0.002, -0.001))
POSE = reference.look_at((0.3, 0.08, 0.02), (0.0, 0.0, -1.4))
PLANE, NORMAL = (0.0, 0.0, -1.5), (0.25, -0.15, 1.0)
CENTRE, RADIUS = (0.05, 0.0, -1.35), 0.22
AMBIENT = 0.05


class Scene(NamedTuple):
    """What the camera sees."""

    depth: np.ndarray  # [rows, cols] float64 metres
    points: np.ndarray  # [rows, cols, 3] float64
    uv: np.ndarray  # [rows, cols, 2] float64 projector coordinates
    albedo: np.ndarray  # [rows, cols, 3]
    shaded: np.ndarray  # [rows, cols] bool: the sphere keeps the projector's light off it


def make_scene(*, sphere: bool = True, camera: reference.Device = CAMERA, pose: np.ndarray = POSE,
               centre: tuple[float, float, float] = CENTRE) -> Scene:
    """The scene; without the sphere the plane alone."""
    rays = reference.pixel_rays(camera)
    depth = reference.plane_depth(rays, PLANE, NORMAL)
    if sphere:
        depth = np.fmin(depth, reference.sphere_depth(rays, centre, RADIUS))
    points = rays * depth[..., None]
    u = np.arange(camera.width) / camera.width
    albedo = np.stack([0.5 + 0.3 * u, np.full_like(u, 0.5), 0.8 - 0.3 * u], axis=-1) * np.ones((camera.height, 1, 1))
    to = pose[:3, 3] - points
    clear = np.isnan(reference.sphere_depth(-to, np.array(centre) - pose[:3, 3], RADIUS * 0.999)) if sphere else np.ones(depth.shape, bool)
    on_sphere = np.linalg.norm(points - centre, axis=-1) < RADIUS * 1.001
    facing = (to * (points - centre)).sum(axis=-1) > 0
    return Scene(depth, points, reference.seen_by(PROJECTOR, pose, points), albedo, np.where(on_sphere & sphere, ~facing, ~clear))


def entry_of(device: reference.Device) -> dict[str, Any]:
    return {"resolution": [device.width, device.height], "focal_px": [device.focal] * 2, "principal_px": device.principal.tolist(),
            "distortion": {"model": "brown_conrady", "k": list(device.k), "p": list(device.p)}}


def manifest(frames: list[dict[str, Any]], pose: np.ndarray | None = POSE, *, camera: reference.Device = CAMERA,
             **changes: Any) -> dict[str, Any]:
    data = {"schema": "relit.capture/1", "name": "scene", "camera": {"projection": "perspective", **entry_of(camera)},
            "frames": frames, **changes}
    if pose is not None:
        data.setdefault("projector", {**entry_of(PROJECTOR), "camera_from_projector": pose.tolist()})
    return {key: value for key, value in data.items() if value is not None}


def shown(pattern: dict[str, Any], uv: np.ndarray) -> np.ndarray:
    """[rows, cols] level, 0…1, that a manifest entry shows at projector coordinates; written from the contract, not from our code."""
    if pattern["code"] in ("black", "white"):
        return np.full(uv.shape[:-1], float(pattern["code"] == "white"))
    u = uv[..., 0 if pattern["axis"] == "column" else 1]
    size = PROJECTOR.width if pattern["axis"] == "column" else PROJECTOR.height
    match pattern["code"]:
        case "binary" | "gray":
            code = np.floor(u / pattern.get("stripe_px", 1)).astype(int)
            code = code ^ code >> 1 if pattern["code"] == "gray" else code
            bit = (code >> pattern["bit"] & 1).astype(float)
            return 1 - bit if pattern.get("inverse") else bit
        case "ramp":
            return u / size if pattern["direction"] == "up" else 1 - u / size
        case "kary":
            code = np.floor(u / pattern["stripe_px"]).astype(int)
            values = np.array(pattern.get("levels") or pattern["colors"], dtype=float)
            base = pattern["base"]
            turn = np.clip(code, 0, None) // base ** pattern["digit"] % (2 * base)  # a reflected digit rises, and falls again
            return values[np.minimum(turn, 2 * base - 1 - turn) if pattern.get("reflected") else turn % base]
        case "xor":
            code = np.floor(u / pattern.get("stripe_px", 1)).astype(int)
            code = code ^ code >> 1
            base = pattern["base_bit"]
            bit = code >> pattern["bit"] & 1
            bit = bit ^ (code >> base & 1) if pattern["bit"] > base else bit
            return 1.0 - bit if pattern.get("inverse") else bit.astype(float)
        case "modulated":
            across = uv[..., 1 if pattern["axis"] == "column" else 0]
            turns = u / pattern["period_px"] - pattern["step"] / pattern["steps"]
            wave = (1 + np.cos(2 * np.pi * turns + pattern.get("offset_rad", 0))) / 2
            carrier = across / pattern["carrier_period_px"] - pattern["carrier_step"] / pattern["carrier_steps"]
            return wave * (1 + np.cos(2 * np.pi * carrier)) / 2
        case "phase":
            turns = u / pattern["period_px"] - pattern["step"] / pattern["steps"]
            return (1 + np.cos(2 * np.pi * turns + pattern.get("offset_rad", 0))) / 2
    raise ValueError(pattern["code"])


def gray_patterns(axis: str, *, stripe: int = 1, inverse: bool = True) -> list[dict[str, Any]]:
    size = PROJECTOR.width if axis == "column" else PROJECTOR.height
    bits = int(np.ceil(np.log2(size / stripe)))
    return [{"code": "gray", "axis": axis, "bit": bit, "bits": bits, "stripe_px": stripe, "inverse": turned}
            for bit in reversed(range(bits)) for turned in ((False, True) if inverse else (False,))]


def entries_of(patterns: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The entries of frames that show these patterns, without their images."""
    return [{"pattern": pattern} for pattern in patterns]


def phase_patterns(axis: str, period: float, steps: int = 4) -> list[dict[str, Any]]:
    return [{"code": "phase", "axis": axis, "period_px": period, "step": step, "steps": steps} for step in range(steps)]


BLACK_WHITE = [{"code": "black"}, {"code": "white"}]


def write_patterns(folder: Path, scene: Scene, patterns: list[dict[str, Any]], *, suffix: str = "png", noise: float = 0.0,
                   level: float = 0.8, gamma: float = 1.0, seed: int = 7, **changes: Any) -> Path:
    """A capture of these patterns: 16-bit PNG, or float EXR, with ambient light and noise."""
    rng, images = np.random.default_rng(seed), []
    for pattern in patterns:
        light = shown(pattern, scene.uv) ** gamma
        light = light * ~(scene.shaded if light.ndim == 2 else scene.shaded[..., None])
        image = scene.albedo * (level * (light if light.ndim == 3 else light[..., None]) + AMBIENT)
        images.append(np.clip(image + rng.normal(0, noise, image.shape[:2])[..., None], 0, 1) if noise else image)
    write_manifest(folder, manifest(write_images(folder, images, entries_of(patterns), f"{{:02d}}.{suffix}"), **changes))
    return folder


def depth_of(folder: Path, **options: Any) -> DepthResult:
    """What relit depth makes of a capture."""
    return depth(DepthRequest(capture=folder, out=folder / "out", device="cpu", **options))


def grey_light(scene: Scene, patterns: list[dict[str, Any]], *, ambient: float = AMBIENT,
               response: Callable[[np.ndarray], np.ndarray] = lambda level: level) -> np.ndarray:
    """[frames, rows, cols] of the green light under patterns, which a projector shows with this response."""
    level = response(np.array([shown(pattern, scene.uv) for pattern in patterns]))
    return scene.albedo[..., 1] * (0.8 * level * ~scene.shaded + ambient)


def sample_of(frames: np.ndarray, full: float = np.inf) -> Sample:
    """Grey frames [frames, rows, cols] as a sample of pixels whose lines of sight nobody asks for; readings of `full` are saturated."""
    values, still = frames.reshape(len(frames), 1, -1), np.zeros(frames.shape[1:], np.float32)
    saturated = (values >= full)[:, 0] if np.isfinite(full) else None
    return Sample(np.minimum(values, full).astype(np.float32), saturated, still, still, np.ones(still.shape, bool))


def depth_under(folder: Path, patterns: list[dict[str, Any]], light: np.ndarray, *, noise: float = 0.003, seed: int = 4,
                changes: dict[str, Any] | None = None, **options: Any) -> DepthResult:
    """What relit depth makes of grey images of this light, with noise, which are declared to show patterns; `changes`: of the manifest."""
    images = light + np.random.default_rng(seed).normal(0, noise, light.shape)
    write_manifest(folder, manifest(write_images(folder, images, entries_of(patterns), "{:02d}.exr"), **(changes or {})))
    return depth_of(folder, **options)


def write_lasers(folder: Path, scene: Scene, lasers: list[dict[str, Any]], *, width: float, noise: float = 0.0, ambient: bool = True,
                 undeclared: list[dict[str, Any] | None] | None = None, strength: float = 1.0, levels: int | None = None,
                 aside: np.ndarray | None = None, **changes: Any) -> Path:
    """A capture of laser frames, the profile a Gaussian of `width` metres about the plane or ray; `undeclared` are second planes of the
    frames that the manifest does not name; `levels`: steps between black and white, None for floats; `aside`:
    by how many pixels each laser frame lies farther right, None: not at all."""
    rng, images, points = np.random.default_rng(3), [], scene.points
    for number, laser in enumerate([*lasers, *([None] if ambient else [])]):
        glow = np.zeros(points.shape[:2])
        if laser is not None and laser["type"] == "plane":
            normal = np.array(laser["normal"]) / np.linalg.norm(laser["normal"])
            glow = np.exp(-(((points - laser["point_m"]) @ normal) ** 2) / (2 * width**2))
        elif laser is not None:
            direction = np.array(laser["direction"]) / np.linalg.norm(laser["direction"])
            off = points - laser["origin_m"]
            glow = np.exp(-((np.cross(off, direction) ** 2).sum(axis=-1)) / (2 * width**2))
        other = undeclared[number] if undeclared is not None and number < len(undeclared) else None
        if other is not None:
            normal = np.array(other["normal"]) / np.linalg.norm(other["normal"])
            glow = glow + strength * np.exp(-(((points - other["point_m"]) @ normal) ** 2) / (2 * width**2))
        image = AMBIENT * scene.albedo + 0.5 * glow[..., None] * scene.albedo[:, :, :1] * (1.0, 0.05, 0.02)
        if aside is not None and laser is not None:
            image = shift(image, (0, aside[number], 0), order=1, mode="nearest")
        image = np.maximum(image + rng.normal(0, noise, image.shape), 0) if noise else image
        images.append(np.round(image * levels) / levels if levels is not None else image)
    entries = [*({"laser": laser} for laser in lasers), *([{"light": {"type": "off"}}] if ambient else [])]
    write_manifest(folder, manifest(write_images(folder, images, entries), None, **changes))
    return folder
