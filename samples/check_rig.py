"""Check the rig's light transport and truth against closed forms and against Mitsuba's own integrator.

    python samples/check_rig.py                # about two minutes
    python samples/check_rig.py --work rig     # also how much light in the groove is indirect

Exits 1 if one fails.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import rendering
import rig_scene
import rig_sets
import rig_transport
import rig_truth
from rig_scene import HEIGHT, WIDTH, Rig

PLANE_M, PLANE_ALBEDO = 1.3, 0.7  # distance from the projector, which it faces
PASSES = 8
COMPARED = {"gray": 6, "phase": 1, "gray_rows": 4}  # a frame of each set that Mitsuba renders by itself
COMPARED_SPP = 1024


def facing_plane(mi, rig: Rig):
    """Return a wide plane that faces the projector."""
    pose = np.array(rig.projector.camera_from_projector, dtype=np.float64)
    corner, right, up = (pose[:3, :3] @ np.array(x) for x in ((-3.0, -3.0, -PLANE_M), (6.0, 0, 0), (0, 6.0, 0)))
    material = {"type": "diffuse", "reflectance": {"type": "rgb", "value": PLANE_ALBEDO}}
    return mi.load_dict(rig_scene._rectangle(mi, material, pose[:3, 3] + corner, right, up))


def direct_light(mi, shapes: dict, rig: Rig, passes: int) -> tuple[np.ndarray, np.ndarray]:  # [rows, cols, WIDTH], [rows, cols, HEIGHT]
    """Return the radiance through each column and row, without interreflection."""
    scene = mi.load_dict({"type": "scene", **shapes, "projector": rig_scene.emitter(mi, rig.projector)})
    sums = [rig_transport.trace_pass(mi, scene, rig, 500 + i, max_depth=2) for i in range(passes)]
    scale = 1 / (passes * rig_transport.STRATA**2)
    columns, rows = (sum(s[name].astype(np.float64) for s in sums) * scale for name in ("columns", "rows"))
    shape = (rig.camera.height, rig.camera.width)
    return columns.reshape(*shape, -1), rows.reshape(*shape, -1)


def _clean(truth: rig_truth.Truth) -> np.ndarray:
    """Return the lit and unmixed pixels, without those of the outermost projector pixels, which have no neighbour to interpolate with."""
    return truth.lit & ~truth.mixed & (truth.u > 1) & (truth.u < WIDTH - 1) & (truth.v > 1) & (truth.v < HEIGHT - 1)


def check_plane(mi, rig: Rig) -> list[tuple[str, float, float]]:
    """Check that a plane facing the projector has the radiance albedo · irradiance / distance² everywhere."""
    shapes = {"plane": facing_plane(mi, rig)}
    columns, rows = direct_light(mi, shapes, rig, 1)
    truth = rig_truth.trace_truth(mi, shapes, rig)
    inside = truth.lit & ~truth.mixed
    expected = PLANE_ALBEDO * rig_scene.IRRADIANCE / PLANE_M**2
    at = [values.sum(axis=-1)[inside] / expected - 1 for values in (columns, rows)]
    return [("plane, energy over columns: largest relative error", float(np.abs(at[0]).max()), 1e-4),
            ("plane, energy over rows: largest relative error", float(np.abs(at[1]).max()), 1e-4)]  # fmt: skip


def check_place(mi, rig: Rig, shapes: dict, name: str) -> list[tuple[str, float, float]]:
    """Check that a ramp over a uniform image in direct light gives the true projector coordinates."""
    columns, rows = direct_light(mi, shapes, rig, PASSES)
    truth = rig_truth.trace_truth(mi, shapes, rig)
    clean, found = _clean(truth), []
    for axis, values, exact in (("column", columns, truth.u), ("row", rows, truth.v)):
        with np.errstate(invalid="ignore"):
            error = np.abs(values @ (np.arange(values.shape[-1]) + 0.5) / values.sum(axis=-1) - exact)[clean]
        found.append((f"{name}, {axis} of a ramp: median error, pixels", float(np.median(error)), 0.003))
        found.append((f"{name}, {axis} of a ramp: 95th percentile", float(np.percentile(error, 95)), 0.01))
    return found


def mitsuba_picture(mi, rig: Rig, shapes: dict, texture: np.ndarray) -> np.ndarray:  # [rows, cols] projector levels
    """Render the scene under a projected image with Mitsuba's own path integrator, projector and camera."""
    camera = rig.camera
    (cu, cv), (fx, _) = camera.principal_px, camera.focal_px
    sensor = mi.load_dict({
        "type": "perspective",
        "to_world": mi.ScalarTransform4f(np.diag([-1.0, 1.0, -1.0, 1.0])),
        "fov": float(np.degrees(2 * np.arctan(camera.width / (2 * fx)))),
        "fov_axis": "x",
        "principal_point_offset_x": 0.5 - cu / camera.width,  # of the picture against the principal point, not the other way
        "principal_point_offset_y": 0.5 - cv / camera.height,
        "film": rendering.film(camera.width, camera.height),
        "sampler": {"type": "multijitter"},
    })  # fmt: skip
    tracer = rendering.Tracer(mi, shapes, sensor, max_depth=rig_transport.MAX_DEPTH)
    return tracer.emitters({"projector": rig_scene.emitter(mi, rig.projector, texture)}, spp=COMPARED_SPP, seed=7)[..., 0]


def check_mitsuba(mi, rig: Rig, shapes: dict) -> list[tuple[str, float, float]]:
    """Compare sums over the light transport with images that Mitsuba renders directly."""
    from stage.patterns.codes import draw

    scene = mi.load_dict({"type": "scene", **shapes, "projector": rig_scene.emitter(mi, rig.projector)})
    sums = [rig_transport.trace_pass(mi, scene, rig, 700 + i) for i in range(PASSES)]
    names = ("columns", "rows", "spots", "waves")
    lit = {name: sum(s[name] for s in sums) / np.float32(PASSES * rig_transport.STRATA**2) for name in names}
    transport = rig_transport.Transport(**lit, direct=np.zeros(1), ambient=np.zeros(1))
    inner = _clean(rig_truth.trace_truth(mi, shapes, rig))
    found = []
    patterns = {f"{name} {number}": rig_sets.PATTERNS[name]()[number] for name, number in COMPARED.items()}
    for name, pattern in (patterns | {"modulated 5": rig_sets.PATTERNS["modulated"]()[5]}).items():
        ours = rig_sets.light(pattern, transport).reshape(inner.shape)[inner]
        theirs = mitsuba_picture(mi, rig, shapes, draw(pattern, (WIDTH, HEIGHT)))[inner]
        scale = float(np.mean(theirs))
        found.append((f"{name}, mean against Mitsuba: relative difference", abs(float(ours.mean()) / scale - 1), 5e-4))
        found.append((f"{name}, pixels against Mitsuba: RMS over the mean", float(np.sqrt(np.mean((ours - theirs) ** 2))) / scale, 0.02))
    return found


def check_groove(mi, rig: Rig, shapes: dict, work: Path) -> list[tuple[str, float, float]]:
    """Check that about a quarter of the light in the groove came from another surface; print that part there and elsewhere."""
    transport = rig_transport.render_transport(mi, shapes, rig, work / "transport.npz", passes=1)
    truth = rig_truth.trace_truth(mi, shapes, rig)
    total, direct = (x.reshape(truth.lit.shape) for x in (transport.columns.sum(axis=1), transport.direct))
    clean = truth.lit & ~truth.mixed
    share = {name: float(1 - direct[part].sum() / total[part].sum())
             for name, part in (("groove", clean & truth.groove), ("elsewhere", clean & ~truth.groove))}  # fmt: skip
    print(f"indirect light: {100 * share['groove']:.1f} % in the groove, {100 * share['elsewhere']:.1f} % elsewhere")
    return [("groove, indirect light: off a quarter", abs(share["groove"] - 0.25), 0.1)]


def main() -> None:
    """Run the checks and print each with its limit."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--work", type=Path, help="folder with the transport of make_rig.py")
    work = parser.parse_args().work
    mi = rendering.import_mitsuba()
    shapes = rig_scene.shapes(mi)
    plain, distorted = rig_scene.make_rig(), rig_scene.make_rig(distorted=True)
    found = [*check_plane(mi, plain), *check_place(mi, plain, shapes, "scene"), *check_place(mi, distorted, shapes, "distorted"),
             *check_mitsuba(mi, plain, shapes)]  # fmt: skip
    if work is not None:
        found += check_groove(mi, plain, shapes, work)
    for what, value, limit in found:
        print(f"{'ok  ' if value <= limit else 'FAIL'} {what}: {value:.3g} (at most {limit:g})")
    sys.exit(int(any(value > limit for _, value, limit in found)))


if __name__ == "__main__":
    main()
