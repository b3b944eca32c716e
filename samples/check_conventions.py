"""Check that the samples' camera, lights, environment and BRDF are those of relit, against closed forms.

    python samples/check_conventions.py

Every check renders a sphere or integrates the BRDF and compares with arithmetic that knows nothing of Mitsuba.
Exits 1 if one fails.
"""

from __future__ import annotations

import sys

import numpy as np
import rendering
import sky

RESOLUTION, PIXEL_SIZE_M, RADIUS_M, ALBEDO = 64, 0.003, 0.08, 0.6


def sphere_normals() -> tuple[np.ndarray, np.ndarray]:  # -> [H, W, 3], [H, W] bool
    """Return the normals of a sphere at pixel centres by the definition of the camera frame, and where they are far from the outline."""
    row, column = np.mgrid[:RESOLUTION, :RESOLUTION]
    x = (column + 0.5 - RESOLUTION / 2) * PIXEL_SIZE_M / RADIUS_M
    y = (RESOLUTION / 2 - row - 0.5) * PIXEL_SIZE_M / RADIUS_M
    z = np.sqrt(np.clip(1 - x * x - y * y, 0, None))
    return np.stack([x, y, z], -1), z > 0.35


def lambert_ggx_brdf(normal, to_light, to_eye, *, albedo: float, f0: float, roughness: float) -> np.ndarray:
    """Return relit's BRDF, Lambert and GGX, in float64 for directions [..., 3]."""
    alpha_sq = roughness**4
    half = to_light + to_eye
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    nl, nv, nh, vh = ((a * b).sum(-1) for a, b in ((normal, to_light), (normal, to_eye), (normal, half), (to_eye, half)))
    d = alpha_sq / (np.pi * (nh**2 * (alpha_sq - 1) + 1) ** 2)
    smith = 2 * nl * nv / (nv * np.sqrt(alpha_sq + (1 - alpha_sq) * nl**2) + nl * np.sqrt(alpha_sq + (1 - alpha_sq) * nv**2))
    fresnel = f0 + (1 - f0) * (1 - vh) ** 5
    return albedo / np.pi + d * smith * fresnel / (4 * nl * nv)


def check_brdf(mi) -> float:
    """Return the largest relative error of the plug-in, and of its sampling against its own value."""
    import drjit as dr

    rng = np.random.default_rng(1)
    worst = 0.0
    for roughness in (0.18, 0.35, 0.7):
        bsdf = mi.load_dict(
            {
                "type": "relit_preview_surface",
                "diffuse_albedo": {"type": "rgb", "value": [0.3, 0.3, 0.3]},
                "f0": {"type": "uniform", "value": 0.05},
                "roughness": {"type": "uniform", "value": roughness},
            }
        )
        w = rng.normal(size=(2, 10000, 3))
        w /= np.linalg.norm(w, axis=-1, keepdims=True)
        w[..., 2] = np.abs(w[..., 2])
        w = w[:, (w[..., 2] > 0.02).all(0)]
        si = dr.zeros(mi.SurfaceInteraction3f, w.shape[1])
        si.wi = mi.Vector3f(w[0].T)
        value = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(w[1].T)))[0]
        normal = np.broadcast_to([0.0, 0.0, 1.0], w[0].shape)
        expected = lambert_ggx_brdf(normal, w[1], w[0], albedo=0.3, f0=0.05, roughness=roughness) * w[1, :, 2]
        worst = max(worst, np.abs(value / expected - 1).max())

        count = 1_000_000  # reflectance by the plug-in's sampling against a uniform hemisphere
        si = dr.zeros(mi.SurfaceInteraction3f, count)
        si.wi = dr.normalize(mi.Vector3f(0.5, 0.2, 0.8))
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(3, count)
        _, weight = bsdf.sample(mi.BSDFContext(), si, sampler.next_1d(), sampler.next_2d())
        wo = mi.warp.square_to_uniform_hemisphere(sampler.next_2d())
        uniform = np.array(bsdf.eval(mi.BSDFContext(), si, wo))[0].mean() * 2 * np.pi
        sampled = np.array(weight)[0].mean()
        print(f"  roughness {roughness}: reflectance {sampled:.4f} by sampling, {uniform:.4f} by a uniform hemisphere")
        worst = max(worst, abs(sampled / uniform - 1) - 0.01)  # 1 %: the uniform estimate's own noise on a sharp lobe
    return worst


def main() -> None:
    """Run the checks and print each with its error."""
    mi = rendering.import_mitsuba()
    sensor = mi.load_dict(rendering.camera(mi, resolution=RESOLUTION, pixel_size_m=PIXEL_SIZE_M))
    ball = {
        "type": "sphere",
        "radius": RADIUS_M,
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [ALBEDO] * 3}},
    }
    normals, inside = sphere_normals()
    failed = []

    tracer = rendering.Tracer(mi, {"ball": ball}, sensor, max_depth=2)

    def trace(emitters: dict, spp: int) -> np.ndarray:
        return tracer.emitters(emitters, spp=spp, seed=7)

    def report(what: str, error: float, limit: float, cause: str) -> None:
        print(f"{'ok  ' if error <= limit else 'FAIL'} {what}: {error:.2e} (limit {limit:g}: {cause})")
        if not error <= limit:
            failed.append(what)

    for name, direction in (("+x", [1, 0, 0]), ("+y", [0, 1, 0]), ("oblique", [-0.48, 0.36, 0.8])):
        direction = np.array(direction, float)
        image = tracer.light(direction=direction, irradiance=[3, 2, 1], spp=256, seed=7)
        half = RESOLUTION // 2
        left, right, top, bottom = (image[part].sum() for part in (np.s_[:, :half], np.s_[:, half:], np.s_[:half], np.s_[half:]))
        print(f"  {name}: left {left:.1f}, right {right:.1f}, top {top:.1f}, bottom {bottom:.1f}")
        expected = ALBEDO / np.pi * np.array([3, 2, 1]) * np.clip(normals @ direction, 0, None)[..., None]
        away = inside & (np.abs(normals @ direction) > 0.05)
        report(f"light from {name}", np.abs(image - expected)[away].max(), 0.006, "box filter over a curved pixel, 256 samples")

    for row, column in ((30, 160), (60, 20), (100, 120), (45, 201)):
        patch = np.zeros((128, 256, 3))
        patch[row, column] = 1000.0
        direction = sky.directions(256, 128)[row, column]
        irradiance = 1000.0 * sky.solid_angles(256, 128)[row, 0]
        by_map = trace({"sky": sky.as_mitsuba_envmap(mi, patch)}, 1024)
        by_light = trace({"light": rendering.distant_light(mi, direction=direction, irradiance=[irradiance] * 3)}, 1024)
        bright = by_light[..., 1] > 0.05 * by_light.max()
        report(
            f"one pixel of a map (row {row}, column {column}) against a light from {np.round(direction, 2).tolist()}",
            abs(by_map[bright].sum() / by_light[bright].sum() - 1) + np.abs(by_map - by_light)[bright].mean() / by_light.max(),
            0.02,
            "the pixel is 1.4 degrees wide, interpolation rounds its edge",
        )

    environment = sky.make_sky().astype(np.float64)
    image = trace({"sky": sky.as_mitsuba_envmap(mi, environment)}, 2025)
    d, omega = sky.directions(256, 128).reshape(-1, 3), np.repeat(sky.solid_angles(256, 128), 256, 1).reshape(-1)
    irradiance = np.clip(normals[inside] @ d.T, 0, None) @ (environment.reshape(-1, 3) * omega[:, None])
    expected = ALBEDO / np.pi * irradiance
    report("sphere under the sky", np.abs(image[inside] / expected - 1).mean(), 0.02, "Monte Carlo noise at 2025 samples")
    report("its mean", np.abs(image[inside].mean(0) / expected.mean(0) - 1).max(), 0.003, "the same, averaged")
    report("BRDF against its closed form", check_brdf(mi), 1e-3, "float32 of a sharp lobe")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
