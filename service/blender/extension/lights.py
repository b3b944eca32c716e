"""Blender's lights as lights of Relit: distant ones for light keys, near ones for `relit shade`.

Convention:
    A sun of E W/m² has the irradiance E. Point and spot lights of Φ W have the radiant intensity Φ/4π, area lights the radiance Φ/πA on the
    side to which they shine; without Normalize Φ r² and Φ/π. All is tinted by colour and temperature and multiplied by 2^exposure.
    tests/clients/test_blender_lights.py measures each.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import bpy
from mathutils import Matrix, Vector

from . import camera
from .tasks import Failure

FAR = 1000.0
"""Distance of a sun for `relit shade`, which knows near lights alone, in sizes of the object: its direction is right to 0.03°."""


class Subject(NamedTuple):
    """The asset as lights see it."""

    root: bpy.types.Object
    centre: Vector
    """Of the sphere around it, in Blender's world."""
    radius: float
    metres: float
    """Metres of Blender's world in one unit of the camera frame: of a metre, or of a pixel where the capture has no scale."""


def subject_of(root: bpy.types.Object) -> Subject:
    """Return the asset below a root; raise Failure if there is none, or if it is stretched."""
    scale = root.matrix_world.to_scale()
    if max(scale) - min(scale) > 1e-3 * max(scale):
        raise Failure(f"{root.name} is scaled by {tuple(round(each, 3) for each in scale)}: scale it evenly, as Relit stretches no object")
    points = camera.corners(root)
    if not points:
        raise Failure(f"{root.name} has no surface of the asset below it: import the asset again")
    low, high = (Vector(pick(each[axis] for each in points) for axis in range(3)) for pick in (min, max))
    return Subject(root, root.matrix_world @ ((low + high) / 2), (high - low).length / 2 * scale.x, scale.x * root["relit_unit_m"])


def shining(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the lights that Blender would render in the view layer, evaluated; raise Failure if Relit has none like one of them."""
    graph = context.evaluated_depsgraph_get()
    shown = {each for each in _rendered(context.view_layer.layer_collection) if not each.hide_render}
    copies = {each.parent.original: each.object.name for each in graph.object_instances
              if each.is_instance and each.object.type == "LIGHT" and each.parent is not None}
    for each in shown:
        if each in copies or (each.instance_type == "COLLECTION" and _has_light(each.instance_collection)):
            raise Failure(f"{each.name} makes instances of lights{f' ({copies[each]})' if each in copies else ''}, which Relit does not "
                          "follow: make them real, or disable it in renders")
    found = [evaluated(each, graph) for each in sorted(shown, key=lambda each: each.name) if each.type == "LIGHT" and not _is_portal(each)]
    for lamp in found:
        data, linking = lamp.data, getattr(lamp, "light_linking", None)
        cannot = [("nodes", data.use_nodes and data.node_tree is not None), ("no shadow", not data.use_shadow),
                  ("a spread below 180°", data.type == "AREA" and data.spread < math.pi - 1e-3),
                  ("a diffuse or specular factor", data.diffuse_factor != 1 or data.specular_factor != 1),
                  ("light linking", linking and (linking.receiver_collection or linking.blocker_collection)),
                  ("rays that do not see it", not (lamp.visible_diffuse and lamp.visible_glossy)),
                  ("a scale", max(abs(each - 1) for each in lamp.matrix_world.to_scale()) > 1e-3 and data.type != "SUN")]
        if what := [words for words, true in cannot if true]:
            raise Failure(f"the light {lamp.name} has {what[0]}, which Relit does not know: change it, or disable it in renders")
    return found


def evaluated(each: bpy.types.Object, graph: bpy.types.Depsgraph) -> bpy.types.Object:
    """Return an object as it is at the frame; raise Failure where Blender does not move it, because viewports do not show it."""
    found = each.evaluated_get(graph)
    if not found.is_evaluated:
        raise Failure(f"{each.name} is disabled in viewports, where Blender does not move it: enable it there")
    return found


def _rendered(layer: bpy.types.LayerCollection) -> Iterator[bpy.types.Object]:
    """Yield the objects of the collections that renders show."""
    if layer.collection.hide_render:
        return
    if not layer.exclude:
        yield from layer.collection.objects
    for each in layer.children:
        yield from _rendered(each)


def _has_light(collection: bpy.types.Collection | None) -> bool:
    return collection is not None and any(each.type == "LIGHT" or _has_light(each.instance_collection) for each in collection.all_objects)


def _is_portal(lamp: bpy.types.Object) -> bool:
    """Return True for an area that only guides the rays of the world."""
    return lamp.data.type == "AREA" and lamp.data.cycles.is_portal


def distant(lamp: bpy.types.Object, subject: Subject) -> dict:
    """Return a light as a key of a distant disc, as the centre of the object sees it; without the frame."""
    data = lamp.data
    light = _power(data)
    if data.type == "SUN":
        towards = _axis(lamp, 2)
        irradiance = light * (1 if _normalised(data) else math.pi * math.sin(data.angle / 2) ** 2)
        angle = data.angle
    else:
        towards = lamp.matrix_world.translation - subject.centre
        distance = max(towards.length, 1e-6)
        if data.type == "AREA":
            cosine = max(0.0, _axis(lamp, 2).dot(towards.normalized()))
            area = _area(data)
            intensity = light * cosine * (1 if _normalised(data) else area) / math.pi
            radius = math.sqrt(area * cosine / math.pi)
        else:
            intensity, radius = _intensity(lamp, subject), data.shadow_soft_size
        irradiance, angle = intensity / distance**2, 2 * math.atan(radius / distance)
    direction = _from_world(subject) @ towards.normalized()
    return {"direction": [*direction], "irradiance": [*irradiance], "angle_degrees": min(math.degrees(angle), 180.0)}


def near(lamps: list[bpy.types.Object], subject: Subject) -> dict[str, list[dict]]:
    """Return lights as options of `relit shade`: `light`, `sphere` and `rectangle`, each value a list of numbers."""
    found: dict[str, list[dict]] = {"light": [], "sphere": [], "rectangle": []}
    inverse = Matrix.Scale(1 / subject.root["relit_unit_m"], 4) @ subject.root.matrix_world.inverted()
    for lamp in lamps:
        data = lamp.data
        if data.type == "AREA":
            if data.shape not in ("SQUARE", "RECTANGLE"):
                raise Failure(f"the light {lamp.name} is a {data.shape.lower()}, and relit shade has rectangles: make it one, or relight "
                              "the photographs")
            sizes = data.size, data.size if data.shape == "SQUARE" else data.size_y
            edges = [_from_world(subject) @ _axis(lamp, axis) * size / subject.metres for axis, size in enumerate(sizes)]
            radiance = _power(data) / (math.pi * (_area(data) if _normalised(data) else 1))
            found["rectangle"].append({"center_m": [*(inverse @ lamp.matrix_world.translation)], "edge_u_m": [*edges[0]],
                                       "edge_v_m": [*edges[1]], "radiance": [*radiance]})
            continue
        if data.type == "SUN":
            key = distant(lamp, subject)
            far = FAR * 2 * subject.radius
            place = subject.centre + _axis(lamp, 2) * far
            radius, intensity = far * math.sin(data.angle / 2), Vector(key["irradiance"]) * far**2
        else:
            place, radius, intensity = lamp.matrix_world.translation, data.shadow_soft_size, _intensity(lamp, subject)
        if not any(intensity):
            continue
        if radius > 0:
            found["sphere"].append({"center_m": [*(inverse @ place)], "radius_m": [radius / subject.metres],
                                    "radiance": [*(intensity / (math.pi * radius**2))]})
        else:
            found["light"].append({"position_m": [*(inverse @ place)], "intensity": [*(intensity / subject.metres**2)]})
    return {name: lights for name, lights in found.items() if lights}


def _power(data: bpy.types.Light) -> Vector:
    """Return the three channels of a light's energy."""
    tint = data.temperature_color if getattr(data, "use_temperature", False) else (1, 1, 1)  # both are new in Blender 4.5
    power = data.energy * 2 ** getattr(data, "exposure", 0.0)
    return Vector(power * one * other for one, other in zip(data.color, tint, strict=True))


def _normalised(data: bpy.types.Light) -> bool:
    return getattr(data, "normalize", True)  # always before Blender 4.5


def _area(data: bpy.types.AreaLight) -> float:
    other = data.size if data.shape in ("SQUARE", "DISK") else data.size_y
    return data.size * other * (math.pi / 4 if data.shape in ("DISK", "ELLIPSE") else 1)


def _intensity(lamp: bpy.types.Object, subject: Subject) -> Vector:
    """Return the radiant intensity of a point light, or of a spot light whose cone holds all of the object or nothing of it."""
    data = lamp.data
    light = _power(data) * (1 / (4 * math.pi) if _normalised(data) or data.shadow_soft_size == 0 else data.shadow_soft_size**2)
    if data.type != "SPOT":
        return light
    towards = subject.centre - lamp.matrix_world.translation
    off = (-_axis(lamp, 2)).angle(towards)
    half = math.asin(min(1.0, subject.radius / max(towards.length, 1e-9)))
    cosine = math.cos(data.spot_size / 2)
    full = math.acos(min(1.0, cosine + (1 - cosine) * data.spot_blend))  # up to this angle a cone is as bright as in its middle
    if off + half <= full:
        return light
    if off - half >= data.spot_size / 2:
        return Vector((0, 0, 0))
    raise Failure(f"the edge of the cone of the light {lamp.name} falls on the object, and Relit has no cones: widen it or lower its blend")


def _axis(lamp: bpy.types.Object, axis: int) -> Vector:
    """Return an axis of a light in Blender's world; lights shine along their -z."""
    return lamp.matrix_world.to_3x3().col[axis].normalized()


def _from_world(subject: Subject) -> Matrix:
    """Return the rotation from Blender's world to the camera frame."""
    return subject.root.matrix_world.to_quaternion().to_matrix().inverted()
