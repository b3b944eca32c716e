"""Renders an asset that benchmarks.clients.usd_arrays has read with Mitsuba; runs in a Python with mitsuba, which has nothing of relit.

    python one_after_another.py inside_mitsuba.py

The scalar variant needs no LLVM. The material is Mitsuba's `principled`, what it makes of UsdPreviewSurface's metallic workflow.

Convention: as samples/rendering.py and samples/sky.py, whose truths were rendered so. Mitsuba's `envmap` has its first and last row on the
poles, so rows are resampled by the nearest pixel on a finer grid.
"""

import json

import mitsuba as mi
import numpy as np

UPSAMPLE = 4


def main(path: str) -> None:
    """Render the job of this file."""
    with open(path) as stream:
        job = json.load(stream)
    mi.set_variant("scalar_rgb")
    with np.load(job["arrays"]) as stored:
        arrays = dict(stored)
    meshes = sorted({name.partition(".")[0] for name in arrays})
    shapes = {f"mesh_{each}": mesh(each, {name.partition(".")[2]: value for name, value in arrays.items()
                                         if name.startswith(f"{each}.")}) for each in meshes}
    points = np.concatenate([arrays[f"{each}.points"] for each in meshes])
    camera_from_world = np.linalg.inv(job["camera"]["world_from_camera"] or np.eye(4))
    depths = -(points @ camera_from_world[2, :3] + camera_from_world[2, 3])
    world_from_camera = np.linalg.inv(camera_from_world)
    scene = mi.load_dict({"type": "scene", **shapes, "light": light(job, world_from_camera),
                          "sensor": sensor(job["camera"], world_from_camera, float(depths.min()), float(depths.max())),
                          "integrator": {"type": "path", "max_depth": job["bounces"], "rr_depth": 1000, "hide_emitters": True}})
    mi.Bitmap(np.ascontiguousarray(mi.render(scene, spp=job["samples"], seed=1), dtype=np.float32),
              mi.Bitmap.PixelFormat.RGBA).write(job["out"])


def texture(values: np.ndarray) -> dict:
    """Return a value or an image as a texture."""
    if values.ndim == 3:
        return {"type": "bitmap", "bitmap": mi.Bitmap(np.ascontiguousarray(values)), "raw": True, "wrap_mode": "clamp"}
    if values.size == 3:
        return {"type": "rgb", "value": values.astype(float).tolist()}
    return {"type": "uniform", "value": float(values)}


def mesh(name: str, arrays: dict) -> object:
    """Return a mesh with its material."""
    bsdf = {"type": "principled", "base_color": texture(arrays["diffuseColor"]), "metallic": texture(arrays["metallic"]),
            "roughness": texture(arrays["roughness"]), "eta": float(arrays["ior"])}
    if arrays["normal"].ndim == 3:
        bsdf = {"type": "normalmap", "normalmap": texture(arrays["normal"] * np.float32(0.5) + np.float32(0.5)), "bsdf": bsdf}
    bsdf = {"type": "twosided", "bsdf": bsdf}
    if arrays["opacity"].ndim == 3 or arrays["opacity"] != 1:
        bsdf = {"type": "mask", "opacity": texture(arrays["opacity"]), "bsdf": bsdf}
    props = mi.Properties()
    props["bsdf"] = mi.load_dict(bsdf)
    shape = mi.Mesh(f"mesh_{name}", len(arrays["points"]), len(arrays["triangles"]), props=props, has_vertex_normals=True,
                    has_vertex_texcoords=True)
    params = mi.traverse(shape)
    params["vertex_positions"] = arrays["points"].ravel()
    params["vertex_normals"] = arrays["normals"].ravel()
    params["vertex_texcoords"] = np.stack([arrays["st"][:, 0], 1 - arrays["st"][:, 1]], axis=-1).ravel()  # rows of bitmaps run down
    params["faces"] = arrays["triangles"].ravel()
    params.update()
    return shape


def light(job: dict, world_from_camera: np.ndarray) -> dict:
    """Return the job's light as an emitter."""
    if "sun" in job:
        direction = world_from_camera[:3, :3] @ np.array(job["sun"]["direction"])
        return {"type": "directional", "direction": [-float(each) for each in direction],
                "irradiance": {"type": "rgb", "value": list(job["sun"]["irradiance"])}}
    picture = np.load(job["environment"])
    height = len(picture)
    rows = height * UPSAMPLE + 1
    row = np.minimum((np.arange(rows) / (rows - 1) * height).astype(int), height - 1)
    turn = np.eye(4)
    turn[:3, :3] = world_from_camera[:3, :3]
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(np.repeat(picture[row], UPSAMPLE, axis=1))),
            "to_world": mi.ScalarTransform4f(turn)}


def sensor(camera: dict, world_from_camera: np.ndarray, nearest: float, farthest: float) -> dict:
    """Return the capturing camera."""
    width, height = camera["resolution"]
    film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgba", "component_format": "float32",
            "rfilter": {"type": "box"}}
    half_turn = np.diag([-1.0, 1.0, -1.0, 1.0])  # Mitsuba's cameras look along +z with +x to the left
    world = mi.ScalarTransform4f(world_from_camera)
    cu, cv = camera["principal_px"] or (width / 2, height / 2)
    if camera["projection"] == "perspective":
        fx, fy = camera["focal_px"]
        if abs(fx - fy) > 1e-6 * fx:
            raise SystemExit("Mitsuba has square pixels only")
        return {"type": "perspective", "fov": float(np.degrees(2 * np.arctan(width / (2 * fx)))), "fov_axis": "x", "film": film,
                "principal_point_offset_x": (width / 2 - cu) / width, "principal_point_offset_y": (height / 2 - cv) / height,
                "near_clip": nearest / 2, "far_clip": farthest * 2, "to_world": world @ mi.ScalarTransform4f(half_turn),
                "sampler": {"type": "multijitter"}}
    unit = camera["pixel_size_m"] or 0.001  # without a scale the asset's pixel is a millimetre
    back = unit * width - nearest
    centre = (width / 2 - cu) * unit, (cv - height / 2) * unit, back
    half = unit * width / 2
    return {"type": "orthographic", "film": film, "sampler": {"type": "multijitter"}, "near_clip": unit / 2,
            "far_clip": 2 * unit * width + farthest - nearest,
            "to_world": world @ mi.ScalarTransform4f().translate(centre) @ mi.ScalarTransform4f(half_turn)
            @ mi.ScalarTransform4f().scale([half, half, 1.0])}
