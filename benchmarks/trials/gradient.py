"""Trials of gradient illumination: path traced by Mitsuba 3, with the occlusion and the interreflection that the method does not model."""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy import angles_deg
from benchmarks.trials.trial import Trial
from kernels.status import SOLVED
from service.requests.solve import SolveRequest
from service.solve.solve import solve
from tests.scenes.captures import write_exr, write_image, write_manifest

SIDE, SAMPLES, NOISE = 32, 144, 0.005
PAIRS = [(axis, sign) for axis in "xyz" for sign in (1, -1)]
PAINT, WHITE = (0.6, 0.35, 0.2), (0.85, 0.8, 0.7)


def trials(data: Path | None) -> Iterator[Trial]:
    """Yield what relit solve makes of a single sphere, of spheres beside each other, of a bowl and of waves."""
    try:
        import mitsuba as mi
    except ImportError:
        print("gradient: Mitsuba is missing: pip install 'relit[samples]'")
        return
    mi.set_variant("scalar_rgb")
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        yield _trial(mi, "a sphere", True, {"a": _sphere(0, 0, 0, 0.9, PAINT)})
        yield _trial(mi, "three spheres", False, {"a": _sphere(0, 0, 0, 0.5, PAINT), "b": _sphere(0.7, 0.35, 0.25, 0.36, PAINT),
                                                  "c": _sphere(-0.55, -0.55, 0.3, 0.33, PAINT)})
        yield _trial(mi, "a white bowl", False, {"m": _mesh(mi, place / "bowl.ply", lambda x, y: 0.65 * (x * x + y * y), WHITE)})
        yield _trial(mi, "deep white waves", False,
                     {"m": _mesh(mi, place / "waves.ply", lambda x, y: 0.25 * np.sin(6.5 * x) * np.cos(5 * y), WHITE)})


def _trial(mi: Any, name: str, in_model: bool, shapes: dict[str, Any]) -> Trial:
    """Render the six gradients of a scene, solve them, and return the trial."""
    sensor = {"type": "orthographic", "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]),
              "film": {"type": "hdrfilm", "width": SIDE, "height": SIDE, "rfilter": {"type": "box"}, "pixel_format": "rgb"}}
    theta, phi = np.meshgrid((np.arange(128) + 0.5) / 128 * np.pi, (np.arange(256) + 0.5) / 256 * 2 * np.pi, indexing="ij")
    direction = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], axis=-1)
    rng, frames = np.random.default_rng(2), []
    for number, (axis, sign) in enumerate(PAIRS):
        value = np.repeat((1 + sign * direction[..., "xyz".index(axis)])[..., None] / 2, 3, axis=2).astype(np.float32)
        light = {"type": "envmap", "bitmap": mi.Bitmap(np.concatenate([value, value[:, :1]], axis=1))}
        scene = mi.load_dict({"type": "scene", "integrator": {"type": "path", "max_depth": 12, "hide_emitters": True}, "sensor": sensor,
                              "light": light, **shapes})
        image = np.array(mi.render(scene, spp=SAMPLES, seed=number))[..., :3]
        frames.append(np.maximum(image * (1 + NOISE * rng.normal(size=image.shape)), 0))
    normals = mi.load_dict({"type": "scene", "integrator": {"type": "aov", "aovs": "n:sh_normal"}, "sensor": sensor, **shapes})
    normal = np.array(mi.render(normals, spp=64))[..., :3]
    length = np.linalg.norm(normal, axis=-1)
    mask = length > 0.99  # other pixels hold an outline
    normal = normal / np.maximum(length, 1e-9)[..., None]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        entries = []
        for (axis, sign), image in zip(PAIRS, frames, strict=True):
            file = f"{axis}{sign:+d}.exr"
            write_exr(place / file, image)
            entries.append({"image": file, "light": {"type": "gradient", "axis": axis, "sign": sign}})
        write_image(place / "mask.png", (mask * 255).astype(np.uint8))
        write_manifest(place, {"schema": "relit.capture/1", "name": "trial", "mask": "mask.png", "frames": entries,
                               "camera": {"projection": "orthographic", "resolution": [SIDE, SIDE]}})
        result = solve(SolveRequest(capture=place, out=place / "out", cache=place / "cache"))
    maps = result.maps
    return Trial(f"gradient, {name}", in_model, angles_deg(maps.normal[mask], normal[mask]), maps.sigma[mask], maps.confidence[mask],
                 np.isin(maps.status[mask], SOLVED), "°", "; ".join(result.warnings))


def _material(albedo: tuple[float, float, float]) -> dict[str, Any]:
    return {"type": "twosided", "inner": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(albedo)}}}


def _sphere(x: float, y: float, z: float, radius: float, albedo: tuple[float, float, float]) -> dict[str, Any]:
    return {"type": "sphere", "center": [x, y, z], "radius": radius, "bsdf": _material(albedo)}


def _mesh(mi: Any, path: Path, height: Any, albedo: tuple[float, float, float], count: int = 160) -> dict[str, Any]:
    """Return a height field as a mesh, written to a file."""
    x, y = np.meshgrid(*[np.linspace(-1.05, 1.05, count)] * 2)
    corner = np.arange(count * count).reshape(count, count)
    a, b, c, d = (part.reshape(-1) for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    mesh = mi.Mesh("field", count * count, 2 * len(a), has_vertex_normals=True)
    values = mi.traverse(mesh)
    values["vertex_positions"] = np.stack([x, y, height(x, y)], axis=-1).astype(np.float32).ravel()
    values["faces"] = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.uint32).ravel()
    values.update()
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path), "bsdf": _material(albedo)}
