"""Common parts of the sample scripts: Mitsuba with relit's camera and lights, and ray-cast ground truth.

Mitsuba is a development dependency: `import_mitsuba` is the only place that imports it.
"""

from __future__ import annotations

import ctypes.util
import os
from typing import Any

import numpy as np
import preview_surface
from capture_files import Truth

LLVM_VERSIONS = (21, 20, 19, 18, 17, 16)  # 15 and older abort with "Cannot select: fminimum"
CAMERA_DISTANCE_M = 1.0  # only in front of everything: an orthographic image does not depend on it
COVERAGE_SUBSAMPLES = 17  # rays per pixel side, edges included, that must all hit for a pixel to be in the mask


def import_mitsuba(variant: str = "llvm_ad_rgb") -> Any:
    """Return the mitsuba module with a variant set and, unless it is `scalar_rgb`, relit's BRDF registered.

    The scalar variant needs no LLVM, but calls a BSDF in Python for every ray.

    Raises:
        SystemExit: in one sentence, when mitsuba or a usable LLVM is missing.
    """
    if "DRJIT_LIBLLVM_PATH" not in os.environ:
        names = (ctypes.util.find_library(f"LLVM-{version}") for version in LLVM_VERSIONS)
        found = next((name for name in names if name), None)
        if found:
            os.environ["DRJIT_LIBLLVM_PATH"] = found
    try:
        import mitsuba as mi
    except ImportError:
        raise SystemExit("mitsuba is not installed: it renders the samples, get it with 'pip install mitsuba'.") from None
    if variant == "scalar_rgb":
        mi.set_variant(variant)
        return mi
    try:
        mi.set_variant(variant)
        mi.Float(1) + 1
    except Exception as error:
        raise SystemExit(
            f"Mitsuba found no usable LLVM ({error}): install libllvm19 and set DRJIT_LIBLLVM_PATH to its library."
        ) from None
    preview_surface.register(mi)
    return mi


def fibonacci_sphere(count: int) -> np.ndarray:  # -> [N, 3] float64, unit
    """Return directions that are spread evenly over the sphere, from +y to -y.

    The committed captures were rendered from these directions, so `stage.transforms.fibonacci_sphere`, which runs from +z to -z, must
    not replace them.

    Source: Gonzalez 2010, "Measurement of areas on a sphere using Fibonacci and latitude-longitude lattices".
    """
    i = np.arange(count) + 0.5
    y = 1 - 2 * i / count
    azimuth = np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - y**2)
    return np.stack([ring * np.sin(azimuth), y, ring * np.cos(azimuth)], axis=1)


def fibonacci_cap(count: int, largest_angle_degrees: float) -> np.ndarray:  # -> [N, 3] float64, unit
    """Return directions that are spread evenly over the cap of the sphere within an angle of +z."""
    i = np.arange(count) + 0.5
    z = 1 - (1 - np.cos(np.radians(largest_angle_degrees))) * i / count
    azimuth = np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)


def camera(mi, *, resolution: int, pixel_size_m: float) -> dict:
    """Return an orthographic sensor at +z that looks along -z, +x right and +y up, with a box filter.

    Convention: Mitsuba's local camera x points left in the picture, which look_at already turns round;
    `make_owl.py --check` measures that it does.
    """
    half_width = 0.5 * resolution * pixel_size_m
    look = mi.ScalarTransform4f().look_at(origin=[0, 0, CAMERA_DISTANCE_M], target=[0, 0, 0], up=[0, 1, 0])
    return {
        "type": "orthographic",
        "near_clip": 0.01,
        "far_clip": 10.0,
        "to_world": look @ mi.ScalarTransform4f().scale([half_width, half_width, 1.0]),
        "film": film(resolution, resolution),
        "sampler": {"type": "multijitter"},  # half the noise of independent samples at 256 a pixel
    }


def film(width: int, height: int) -> dict:
    """Return a film of linear float values with a box filter."""
    return {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb", "component_format": "float32",
            "rfilter": {"type": "box"}}


def mesh(mi, name: str, surface, *, lambertian: bool = False) -> Any:
    """Turn a `Surface` (see meshing.py) into a Mitsuba mesh with per-vertex materials.

    `lambertian` leaves the specular lobe out altogether (F0 = 0 would not: Schlick's term remains).
    """
    albedo = {"type": "mesh_attribute", "name": "vertex_albedo"}
    coat = {
        "type": preview_surface.PLUGIN_NAME,
        "diffuse_albedo": albedo,
        "f0": {"type": "mesh_attribute", "name": "vertex_f0"},
        "roughness": {"type": "mesh_attribute", "name": "vertex_roughness"},
    }
    return mesh_with(mi, name, surface, {"type": "diffuse", "reflectance": albedo} if lambertian else coat, materials(surface))


def materials(surface) -> dict[str, np.ndarray]:
    """Return the materials of a `Surface` as `mesh_with` takes them."""
    return {"albedo": surface.albedo, "f0": surface.f0, "roughness": surface.roughness}


def mesh_with(mi, name: str, surface, bsdf: dict, attributes: dict[str, np.ndarray]) -> Any:
    """Turn points, faces and normals into a Mitsuba mesh with a BSDF, which reads attributes of the vertices, [V] or [V, 3], by
    `vertex_` and their names."""
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    shape = mi.Mesh(name, len(surface.points), len(surface.faces), props=props, has_vertex_normals=True)
    for attribute, values in attributes.items():
        shape.add_attribute(f"vertex_{attribute}", values.size // len(surface.points), values.astype(np.float32).ravel())
    params = mi.traverse(shape)
    params["vertex_positions"] = surface.points.astype(np.float32).ravel()
    params["vertex_normals"] = surface.normals.astype(np.float32).ravel()
    params["faces"] = surface.faces.astype(np.uint32).ravel()
    params.update()
    return shape


def distant_light(mi, *, direction: np.ndarray, irradiance) -> dict:
    """Return an emitter from `direction` (towards the light); a surface that faces it receives `irradiance` [3]."""
    return {
        "type": "directional",
        "direction": [-float(d) for d in direction],
        "irradiance": {"type": "rgb", "value": [float(e) for e in irradiance]},
    }


class Tracer:
    """A scene of fixed shapes to path trace under one set of emitters after another.

    The first distant light is moved rather than rebuilt, so that Mitsuba keeps its acceleration structure.
    """

    def __init__(self, mi, shapes: dict, sensor, *, max_depth: int):
        self.mi, self.shapes, self.sensor = mi, shapes, sensor
        self.integrator = {"type": "path", "max_depth": max_depth, "rr_depth": 1000, "hide_emitters": True}
        self.one_light = None

    def _scene(self, emitters: dict):
        return self.mi.load_dict({"type": "scene", "integrator": self.integrator, **self.shapes, **emitters})

    def light(self, *, direction: np.ndarray, irradiance, spp: int, seed: int, passes: int = 1) -> np.ndarray:
        """Render the radiance [H, W, 3] under one distant light (see `distant_light`)."""
        emitter = distant_light(self.mi, direction=direction, irradiance=irradiance)
        if self.one_light is None:
            self.one_light = self._scene({"light": emitter})
        params = self.mi.traverse(self.one_light)
        params["light.to_world"] = self.mi.load_dict(emitter).world_transform()
        params["light.irradiance.value"] = self.mi.Color3f(*(float(e) for e in irradiance))
        params.update()
        return self._trace(self.one_light, spp, seed, passes)

    def emitters(self, emitters: dict, *, spp: int, seed: int, passes: int = 1) -> np.ndarray:
        """Render the radiance [H, W, 3] under any emitters, given as Mitsuba dictionaries."""
        return self._trace(self._scene(emitters), spp, seed, passes)

    def _trace(self, scene, spp: int, seed: int, passes: int) -> np.ndarray:
        """Return the mean of `passes` independent renders of `spp` paths, which bounds the memory; float32 linear radiance."""
        total = 0.0
        for i in range(passes):
            image = self.mi.render(scene, sensor=self.sensor, spp=spp, seed=seed * 4096 + i)
            total = total + np.array(image, dtype=np.float64)
        return (total / passes).astype(np.float32)


def cast(mi, scene, u: np.ndarray, v: np.ndarray, *, resolution: int, pixel_size_m: float):
    """Cast camera rays through continuous image coordinates (u, v) and return Mitsuba's interaction."""
    x = (u - 0.5 * resolution) * pixel_size_m
    y = (0.5 * resolution - v) * pixel_size_m
    origin = mi.Point3f(mi.Float(x.ravel()), mi.Float(y.ravel()), CAMERA_DISTANCE_M)
    return scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(0, 0, -1)))


def trace_truth(mi, shapes: dict, *, resolution: int, pixel_size_m: float) -> Truth:
    """Return normal, material and height at pixel centres, and coverage over whole pixels, by ray casting."""
    scene = mi.load_dict({"type": "scene", **shapes})
    row, column = np.mgrid[:resolution, :resolution]
    covered = np.ones((resolution, resolution), bool)
    for dv in np.linspace(0, 1, COVERAGE_SUBSAMPLES):
        for du in np.linspace(0, 1, COVERAGE_SUBSAMPLES):
            hit = cast(mi, scene, column + du, row + dv, resolution=resolution, pixel_size_m=pixel_size_m)
            covered &= np.array(hit.is_valid()).reshape(covered.shape)
    si = cast(mi, scene, column + 0.5, row + 0.5, resolution=resolution, pixel_size_m=pixel_size_m)
    grid = (resolution, resolution)

    def attribute(name: str, channels: int) -> np.ndarray:
        if channels == 1:
            return np.array(si.shape.eval_attribute_1(name, si, si.is_valid())).reshape(grid)
        return np.array(si.shape.eval_attribute_3(name, si, si.is_valid())).T.reshape(*grid, 3)

    inside = covered[..., None]
    normal, facet = np.array(si.sh_frame.n).T, np.array(si.n).T
    # In a few creases the interpolated normal looks away from the camera, which no visible surface can: take the facet's,
    # turned round where displacement folded the mesh inside out.
    normal = np.where(normal[:, 2:] > 0, normal, facet * np.where(facet[:, 2:] > 0, 1, -1))
    return Truth(
        normal=normal.reshape(*grid, 3) * inside,
        diffuse_albedo=attribute("vertex_albedo", 3) * inside,
        f0=attribute("vertex_f0", 1) * covered,
        roughness=attribute("vertex_roughness", 1) * covered,
        height=np.where(covered, np.array(si.p.z).reshape(grid), 0).astype(np.float32),
        mask=covered,
    )
