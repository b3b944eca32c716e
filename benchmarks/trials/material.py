"""The general solver on path-traced metal and gloss under many, few and frontal lights, and on the real cat.

Mitsuba traces a lumpy body with its own BSDFs (rough conductors, `principled`), with interreflection; noise and 8-bit rounding are added.
"""

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from benchmarks.accuracy import angles_deg
from benchmarks.trials.trial import Trial
from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.formats import exr
from stage.importers import diligent
from tests.reference.sampling import lattice

SIDE, PATHS, BOUNCES = 72, 64, 4
LIGHTS, WIDEST_DEGREES, FRONTAL_DEGREES = 64, 75.0, 43.0
NOISE = 0.01
MATT = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.4, 0.3]}}
GLOSS = {"type": "principled", "base_color": {"type": "rgb", "value": [0.45, 0.3, 0.2]}, "roughness": 0.4, "specular": 0.5}
GOLD = {"type": "roughconductor", "distribution": "ggx", "alpha": 0.22, "material": "Au"}
CHROME = {"type": "roughconductor", "distribution": "beckmann", "alpha": 0.35, "material": "Cr"}


class Case(NamedTuple):
    """One way to photograph a body."""

    name: str
    bsdf: dict[str, Any]
    lights: int = LIGHTS
    frontal: bool = False
    """Lights within 43° of the view, and 8-bit images."""
    in_model: bool = True
    tilt_degrees: float = 0.0
    """How far the lights that the manifest gives are off."""
    ball: bool = False
    """A ball of the same material floats before the body."""
    ground: float = 0.0
    """Albedo of a table that the body lies on; 0: there is none."""


LOW = -0.95
"""Height of the table, just below the body."""
BALL = {"type": "sphere", "center": [0.25, 0.2, 1.6], "radius": 0.28}
CASES = (
    Case("svbrdf, matt, 64 lights", MATT),
    Case("svbrdf, matt, a ball before the body, 64 lights", MATT, ball=True),
    Case("svbrdf, gloss, a ball before the body, 64 lights", GLOSS, ball=True),
    Case("svbrdf, metal, a ball before the body, 64 lights", GOLD, ball=True),
    Case("svbrdf, matt, on a white table, 24 lights", MATT, lights=24, ground=0.7),
    Case("svbrdf, gloss, on a white table, 24 lights", GLOSS, lights=24, ground=0.7),
    Case("svbrdf, gloss, 64 lights", GLOSS),
    Case("svbrdf, metal, 64 lights", GOLD),
    Case("svbrdf, metal of another lobe, 64 lights", CHROME, in_model=False),
    Case("svbrdf, metal, 14 lights", GOLD, lights=14, in_model=False),
    Case("svbrdf, gloss, 3 lights", GLOSS, lights=3, in_model=False),
    Case("svbrdf, gloss, 12 frontal lights", GLOSS, lights=12, frontal=True),
    Case("svbrdf, matt, 12 frontal lights 5° off", MATT, lights=12, frontal=True, in_model=False, tilt_degrees=5.0),
)


class Body(NamedTuple):
    """Images of a body and its truth."""

    images: np.ndarray  # [lights, rows, cols, 3] radiance under irradiance π
    normal: np.ndarray  # [rows, cols, 3]
    mask: np.ndarray  # [rows, cols] bool


def spread(directions: np.ndarray, count: int, widest_degrees: float) -> np.ndarray:
    """Return the indices of directions that lie far from each other, within an angle of +z."""
    left = np.flatnonzero(directions[:, 2] >= np.cos(np.radians(widest_degrees)))
    chosen = [int(left[0])]
    while len(chosen) < count:
        chosen.append(int(left[np.argmin((directions[left] @ directions[chosen].T).max(axis=1))]))
    return np.array(chosen)


def lump(mi: Any, bsdf: dict[str, Any]) -> Any:
    """Return the mesh of a lumpy ball."""
    rows, cols = 256, 512
    v, u = np.meshgrid(np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, cols, endpoint=False), indexing="ij")
    unit = np.stack([np.sin(v) * np.cos(u), np.cos(v), np.sin(v) * np.sin(u)], axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(31)
    radius = np.ones(len(unit))
    for frequency in (2.0, 3.0, 3.5, 5.0):
        wave = rng.normal(size=3)
        radius += 0.28 / frequency * np.sin(unit @ (frequency * wave / np.linalg.norm(wave)) + rng.uniform(0, 6))
    points = unit * radius[:, None]
    points *= 0.94 / np.abs(points).max()
    a = (np.arange(rows - 1)[:, None] * cols + np.arange(cols)).ravel()
    b = (np.arange(rows - 1)[:, None] * cols + (np.arange(cols) + 1) % cols).ravel()
    faces = np.concatenate([np.stack([a, b, a + cols], 1), np.stack([b, b + cols, a + cols], 1)])
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("lump", len(points), len(faces), props=props, has_vertex_normals=True)
    across = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    normals = np.zeros_like(points)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], across)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    normals *= np.sign((normals * points).sum(axis=1, keepdims=True))
    params = mi.traverse(mesh)
    for key, values in (("vertex_positions", points), ("vertex_normals", normals)):
        params[key] = values.astype(np.float32).ravel()
    params["faces"] = faces.astype(np.uint32).ravel()
    params.update()
    return mesh


def render(mi: Any, bsdf: dict[str, Any], directions: np.ndarray, *, ball: bool, ground: float = 0.0) -> Body:
    """Trace the body under each light, and its normals; with a ball before it, and on a table of that albedo, where they are asked for."""
    def sun(way: np.ndarray) -> dict[str, Any]:
        return {"type": "directional", "direction": [float(-x) for x in way], "irradiance": {"type": "rgb", "value": [np.pi] * 3}}

    film = {"type": "hdrfilm", "width": SIDE, "height": SIDE, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": "orthographic", "film": film, "sampler": {"type": "independent"},
                           "to_world": mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])})
    things = {"body": lump(mi, bsdf), **({"ball": BALL | {"bsdf": bsdf}} if ball else {})}
    table = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, LOW]).scale([4, 4, 1]),
             "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [ground] * 3}}}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path", "max_depth": BOUNCES, "hide_emitters": True},
                          "sun": sun(directions[0]), **things, **({"table": table} if ground else {})})
    alone = mi.load_dict({"type": "scene", **things})
    images = []
    for seed, way in enumerate(directions):
        params = mi.traverse(scene)
        params["sun.to_world"] = mi.load_dict(sun(way)).world_transform()
        params.update()
        images.append(np.array(mi.render(scene, sensor=sensor, spp=PATHS, seed=seed)))

    def hit(row: float, col: float) -> Any:
        return alone.ray_intersect(mi.Ray3f(mi.Point3f(col * 2 / SIDE - 1, 1 - row * 2 / SIDE, 3.0), mi.Vector3f(0, 0, -1)))

    covered = np.array([[hit(row / 2, col / 2).is_valid() for col in range(2 * SIDE + 1)] for row in range(2 * SIDE + 1)])
    mask = np.all([covered[i : i + 2 * SIDE : 2, j : j + 2 * SIDE : 2] for i in range(3) for j in range(3)], axis=0)
    normal = np.array([[np.array(hit(row + 0.5, col + 0.5).sh_frame.n) for col in range(SIDE)] for row in range(SIDE)])
    return Body(np.stack(images), normal, mask & (normal[..., 2] > 0.02))


def photograph(case: Case, body: Body, directions: np.ndarray, folder: Path) -> Path:
    """Write a capture of the body as the case says."""
    chosen = spread(directions, case.lights, FRONTAL_DEGREES if case.frontal else 90.0)
    rng, frames = np.random.default_rng(7), []
    white = float(np.percentile(body.images[chosen][:, body.mask], 99.7))
    for number, index in enumerate(chosen):
        image = body.images[index] * (1 + NOISE * rng.normal(size=body.images[index].shape))
        image = np.maximum(image + 0.001 * white * rng.normal(size=image.shape), 0)
        name, irradiance = f"{number:03d}.exr", np.pi
        if case.frontal:
            name, irradiance = f"{number:03d}.png", np.pi / white
            cv2.imwrite(str(folder / name), np.clip(np.round(image[..., ::-1] / white * 255), 0, 255).astype(np.uint8))
        else:
            planes = {channel: image[..., place].astype(np.float16) for place, channel in enumerate("RGB")}
            exr.write(folder / name, planes, color_space="lin_rec709_scene", metadata={})
        way = directions[index] + np.tan(np.radians(case.tilt_degrees)) / 2**0.5 * rng.normal(size=3)
        frames.append({"image": name, "light": {"type": "distant", "direction": (way / np.linalg.norm(way)).tolist(),
                                                "irradiance": [irradiance] * 3}})
    cv2.imwrite(str(folder / "mask.png"), (body.mask * 255).astype(np.uint8))
    manifest = {"schema": "relit.capture/1", "name": "lump", "color_space": "lin_rec709_scene", "mask": "mask.png", "frames": frames,
                "camera": {"projection": "orthographic", "resolution": [SIDE, SIDE], "pixel_size_m": 0.001}}
    (folder / "capture.json").write_text(json.dumps(manifest))
    return folder


def judge(name: str, in_model: bool, capture: Path, truth: np.ndarray, mask: np.ndarray) -> Trial:
    """Solve a capture, and return its errors."""
    with tempfile.TemporaryDirectory() as out:
        result = solve(SolveRequest(capture=capture, out=Path(out), method=Method.SVBRDF, cache=Path(out)))
    maps = result.maps
    assert maps.normal is not None and maps.sigma is not None and maps.confidence is not None
    return Trial(name, in_model, angles_deg(maps.normal, truth)[mask], maps.sigma[mask].astype(np.float64),
                 maps.confidence[mask].astype(np.float64), maps.mask[mask], "°", " ".join(result.warnings))


def trials(data: Path | None) -> Iterator[Trial]:
    """Yield the trials.

    Args:
        data: folder with diligent_ball and diligent_cat; None: without them.
    """
    try:
        import mitsuba as mi

        mi.set_variant("scalar_rgb")  # the one that needs no compiler
    except ImportError:
        print("material: Mitsuba is missing, its scenes are left out: pip install 'relit[samples]'")
    else:
        directions = lattice(LIGHTS, WIDEST_DEGREES)
        bodies: dict[str, Body] = {}
        for case in CASES:
            key = json.dumps([case.bsdf, case.ball, case.ground])
            if key not in bodies:
                bodies[key] = render(mi, case.bsdf, directions, ball=case.ball, ground=case.ground)
            with tempfile.TemporaryDirectory() as folder:
                capture = photograph(case, bodies[key], directions, Path(folder))
                yield judge(case.name, case.in_model, capture, bodies[key].normal, bodies[key].mask)
    for name in () if data is None else ("ball", "cat"):
        with tempfile.TemporaryDirectory() as folder:
            source, capture = data / f"diligent_{name}", Path(folder) / "capture"
            diligent.import_folder(source, capture)
            mask = cv2.imread(str(source / "mask.png"), cv2.IMREAD_GRAYSCALE)
            assert mask is not None
            yield judge(f"svbrdf, DiLiGenT {name}", True, capture, np.load(source / "normal_gt.npz")["normal"], mask > 0)
