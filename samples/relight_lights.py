"""The light of the relighting checks: environments, near lights, and what both look like to Mitsuba.

A light is described by the dictionary that references.json records; `emitters` renders from that very dictionary, so a
reader's numbers are the renderer's.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import rendering
import sky

ENVIRONMENT_WIDTH = 512  # a pixel is 0.7 degrees, a quarter of the sun's diameter
ENVMAP_UPSAMPLE = 4  # see sky.as_mitsuba_envmap; makes the 2048 columns that the 256-pixel maps of the owl get
PATCHES = (  # direction from the object, sigma in degrees, peak radiance
    ((-0.70, 0.20, 0.70), 20.0, (4.0, 2.1, 0.9)),  # left-front
    ((0.10, 0.97, 0.20), 30.0, (0.7, 1.2, 1.8)),  # top
    ((0.80, 0.15, -0.58), 25.0, (2.4, 0.8, 2.8)),  # right-back
)
PATCHES_GROUND = (0.04, 0.05, 0.06)
NEAR_DIRECTION, NEAR_RADII = (0.45, 0.50, 0.74), 1.3  # from the object's centre; in front, up and to the right
SPHERE_DIRECTION, RECTANGLE_DIRECTION = (-0.70, 0.45, 0.55), (0.75, 0.15, 0.65)  # beside the camera's view of the object
AREA_RADII = 2.0  # distance of both area lights
SPHERE_RADII, RECTANGLE_RADII = 0.25, (1.0, 0.6)  # radius; width and height
IRRADIANCE = 3.0  # about what each near light gives a surface at the object's centre
NEAR_COLOR, SPHERE_COLOR, RECTANGLE_COLOR = (1.0, 0.9, 0.8), (1.0, 0.75, 0.5), (0.6, 0.8, 1.0)


def make_patches(width: int = ENVIRONMENT_WIDTH // 2) -> np.ndarray:  # -> [H, W, 3] half, linear Rec.709 radiance
    """Return a lat-long map of three soft Gaussian patches on a dim ground, smooth at the spacing of the captured lights."""
    towards = sky.directions(width, width // 2)
    picture = np.broadcast_to(np.array(PATCHES_GROUND), towards.shape).copy()
    for direction, sigma_degrees, radiance in PATCHES:
        apart = np.degrees(np.arccos(np.clip(towards @ unit(direction), -1, 1)))
        picture += np.exp(-0.5 * (apart / sigma_degrees) ** 2)[..., None] * np.array(radiance)
    return picture.astype(np.float16)


def unit(direction) -> np.ndarray:  # -> [3]
    """Return the direction at length one."""
    return np.array(direction, float) / np.linalg.norm(direction)


def bounding_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:  # [N, 3] -> [3], m
    """Return the bounding sphere about the centre of the bounding box."""
    center = (0.5 * (points.min(axis=0) + points.max(axis=0))).round(6)
    return center, round(float(np.linalg.norm(points - center, axis=1).max()), 6)


def near_lights(center: np.ndarray, radius_m: float) -> dict[str, dict]:
    """Return the point, sphere and rectangle light around an object, as references.json describes them."""
    near_m, area_m = NEAR_RADII * radius_m, AREA_RADII * radius_m
    sphere_m, (width, height) = SPHERE_RADII * radius_m, (side * radius_m for side in RECTANGLE_RADII)
    outward = unit(RECTANGLE_DIRECTION)
    across = unit(np.cross([0, 1, 0], outward))
    return {
        "near": {
            "type": "point",
            "position_m": numbers(center + near_m * unit(NEAR_DIRECTION)),
            "intensity": numbers(IRRADIANCE * near_m**2 * np.array(NEAR_COLOR)),
        },
        "sphere_light": {
            "type": "sphere",
            "center_m": numbers(center + area_m * unit(SPHERE_DIRECTION)),
            "radius_m": round(sphere_m, 8),
            "radiance": numbers(IRRADIANCE / np.pi * (area_m / sphere_m) ** 2 * np.array(SPHERE_COLOR)),
        },
        "rectangle_light": {
            "type": "rectangle",
            "center_m": numbers(center + area_m * outward),
            "edge_u_m": numbers(width * across),
            "edge_v_m": numbers(height * np.cross(outward, across)),
            "normal": numbers(-outward),
            "radiance": numbers(IRRADIANCE * area_m**2 / (width * height) * np.array(RECTANGLE_COLOR)),
        },
    }


def numbers(values) -> list[float]:
    """Return floats with few digits for JSON, which are exactly the numbers that are rendered."""
    return [round(float(value), 8) for value in values]


def emitters(mi: Any, light: dict, *, folder: Path, directions: np.ndarray, irradiance: np.ndarray) -> dict:
    """Return Mitsuba's emitters for one description.

    Args:
        light: description, as in references.json.
        folder: holds the environment maps.
        directions: [L, 3] unit, of the captured lights.
        irradiance: [L, 3] of them.
    """
    match light["type"]:
        case "captured":
            return {
                f"light_{i}": rendering.distant_light(mi, direction=directions[i], irradiance=irradiance[i]) for i in light["frames"]
            }
        case "environment":
            picture = np.array(mi.Bitmap(str(folder / light["image"])))
            return {"sky": sky.as_mitsuba_envmap(mi, picture, upsample=ENVMAP_UPSAMPLE)}
        case "point":
            return {"lamp": {"type": "point", "position": light["position_m"], "intensity": _rgb(light["intensity"])}}
        case "sphere":
            shape = {"type": "sphere", "center": light["center_m"], "radius": light["radius_m"]}
        case "rectangle":
            half_u, half_v = (0.5 * np.array(light[edge]) for edge in ("edge_u_m", "edge_v_m"))
            matrix = np.eye(4)  # of Mitsuba's square from -1 to 1, which emits along its +z
            matrix[:3] = np.stack([half_u, half_v, light["normal"], light["center_m"]], axis=1)
            shape = {"type": "rectangle", "to_world": mi.ScalarTransform4f(matrix)}
        case other:
            raise ValueError(f"light type is {other}: one of captured, environment, point, sphere, rectangle")
    black = {"type": "diffuse", "reflectance": _rgb([0, 0, 0])}  # or the lamp would be a grey ball under the object's own light
    return {"lamp": shape | {"bsdf": black, "emitter": {"type": "area", "radiance": _rgb(light["radiance"])}}}


def _rgb(values) -> dict:
    return {"type": "rgb", "value": list(values)}
