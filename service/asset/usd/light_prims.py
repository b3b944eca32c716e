"""The light stage as UsdLux lights, one for each light of a capture, whose intensities replay the capture frame by frame.

The time code of a frame is its place in the manifest, counted from 1; each light has its intensity at its own frames and 0 at all others.
With no time, every light has its own intensity. A tracking frame (light `full`) has all lights on, and an ambient frame (`off`) none.

- distant: a DistantLight of angle 0, whose normalised intensity is the irradiance on a surface that faces it.
- point: a SphereLight, treatAsPoint. Its normalised intensity over 4π r² is its radiance, and that times π r² its radiant intensity, so
  that the former is four times the latter. The anisotropy is the `focus` of its shaping.
- extended: a DistantLight whose disc has the vector irradiance of the samples, Σ L Ω l, and the same spread.
- gradient, environment: a DomeLight.

Source: OpenUSD, UsdLuxLightAPI ("Quantities and Units", normalize), UsdLuxDistantLight, UsdLuxSphereLight, UsdLuxShapingAPI (focus: the
    power of the cosine with the axis). A uniform cone of half-angle θ has the mean direction (1 + cos θ)/2.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, Vt

from service.asset.usd.layers import RIG, AssetLayers
from service.errors import AssetError
from stage.capture.capture import Capture
from stage.capture.light import DistantLight, EnvironmentLight, ExtendedLight, FullLight, GradientLight, PointLight
from stage.capture.manifest import FILE_NAME
from stage.colour.colour import convert
from stage.colour.colour_spaces import linear_space
from stage.colour.environment_maps import read_environment
from stage.formats import exr

LIGHT_SPACE = "lin_rec709_scene"
"""Colour space of the lights: their colours have no declaration that clients read, and all take them as this."""


def write_dome_texture(environment: Path, texture: Path, *, clipped: dict[str, int] | None = None,
                       outside: dict[str, float] | None = None, encodings: dict[str, str] | None = None) -> None:
    """Write a lat-long environment map, .exr or .hdr, as the texture of a dome light, with findings as `read_environment` gives them."""
    write_radiance(read_environment(environment, LIGHT_SPACE, clipped=clipped, outside=outside, encodings=encodings), texture)


def write_radiance(radiance: np.ndarray, texture: Path) -> None:
    """Write radiance [rows, cols, 3] in LIGHT_SPACE as the texture of a dome light: half where half holds the largest value."""
    pixels = radiance.astype(np.float16) if radiance.max() <= exr.HALF_MAX else radiance.astype(np.float32)
    exr.write(texture, {name: pixels[..., channel] for channel, name in enumerate("RGB")}, color_space=LIGHT_SPACE, metadata={})


def define_dome(usd_stage: Usd.Stage, path: Sdf.Path, texture: str | None) -> UsdLux.DomeLight:
    """Define a dome light of intensity 1 whose texture, relative to the layer, is the radiance from every direction; None: white."""
    dome = UsdLux.DomeLight.Define(usd_stage, path)
    dome.CreateIntensityAttr(1.0)
    if texture is not None:
        file = dome.CreateTextureFileAttr(Sdf.AssetPath(texture))
        file.SetColorSpace(LIGHT_SPACE)
        dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
    return dome


def light_colour(rgb: tuple[float, float, float], space: str) -> tuple[float, tuple[float, float, float]]:
    """Return the intensity and colour of a light from its red, green and blue in a scene-linear colour space.

    These are the largest channel in LIGHT_SPACE, and the channels over it; a channel outside of its gamut is 0.
    """
    channels = np.maximum(convert(np.array([[rgb]], np.float32), space, LIGHT_SPACE)[0, 0].astype(np.float64), 0)
    intensity = float(channels.max())
    red, green, blue = channels / (intensity or 1.0)
    return intensity, (red, green, blue)


def outside_gamut(light: DistantLight | PointLight | ExtendedLight, space: str) -> float:
    """Return the part of a light that its colours gain because channels that LIGHT_SPACE has below 0 are set to 0."""
    given = {"distant": "irradiance", "point": "intensity", "extended": "radiance"}[light.type]
    channels = convert(np.array(getattr(light, given), np.float32).reshape(1, -1, 3), space, LIGHT_SPACE)
    whole = float(np.maximum(channels, 0).sum())
    return float(np.maximum(-channels, 0).sum()) / whole if whole > 0 and space != LIGHT_SPACE else 0.0


POINT_RADIUS_M = 0.001
"""Radius of a point light, which has none: for renderers that do not treat it as a point."""
DISPLAY_DISTANCE = 1.5
"""Distance at which distant lights are drawn around the object, in diagonals of its bounding box; their light does not depend on it."""
GRADIENT_ROWS = 64
"""Rows of the texture of a gradient: linear between them it is within 1e-3 of (1 ± ω)/2."""

Placed = DistantLight | PointLight | ExtendedLight | GradientLight | EnvironmentLight
"""The types of light whose place is known."""


class RigLight(NamedTuple):
    """A light, and the frames that it lights."""

    light: Placed
    frames: list[int]  # time codes
    images: list[str]


class _Emission(NamedTuple):
    prim: UsdLux.NonboundableLightBase | UsdLux.BoundableLightBase
    intensity: float
    color: tuple[float, float, float]


def rig_lights(capture: Capture) -> list[RigLight]:
    """Return the different lights of a capture, in the order of their first frames."""
    found: dict[Placed, RigLight] = {}
    gradients = bool(capture.lit_by(GradientLight))
    full: list[tuple[int, str]] = []
    for number, frame in enumerate(capture.manifest.frames, 1):
        light = frame.light
        if isinstance(light, FullLight) and gradients:
            light = GradientLight(type="gradient", axis="full")
        if isinstance(light, FullLight):
            full.append((number, frame.image))
        elif isinstance(light, Placed):
            lit = found.setdefault(light, RigLight(light, [], []))
            lit.frames.append(number)
            lit.images.append(frame.image)
    if not found:
        raise AssetError(f"{capture.folder / FILE_NAME}: frames: none is lit by a light whose place is known, so there is no rig to export")
    for lit in found.values():
        lit.frames.extend(number for number, _ in full)
        lit.images.extend(image for _, image in full)
    return list(found.values())


def define_rig(layers: AssetLayers, capture: Capture, extent: np.ndarray, outside: dict[str, float]) -> list[Path]:
    """Define the variant `rig` of `light` from the lights of a capture, and return the textures of dome lights, beside the layer.
    `extent`: [2, 3] bounding box of the surface, camera frame, scene units. `outside`: is given what colours outside of the gamut of
    LIGHT_SPACE gain, by the image of the light."""
    lights = rig_lights(capture)
    textures: list[Path] = []
    with layers.lighting(RIG) as usd_stage:
        rig = UsdGeom.Scope.Define(usd_stage, layers.root.AppendChild(RIG.capitalize()))
        rig.GetPrim().SetCustomDataByKey("relit:irradiance_scale", capture.manifest.irradiance_scale)
        for lit in lights:
            path = rig.GetPath().AppendChild(f"Light_{lit.frames[0]:04d}")
            emission, texture = _define_light(usd_stage, path, lit, capture, layers.lights, extent, outside)
            if texture is not None:
                textures.append(texture)
            _set_emission(emission, lit, len(capture.manifest.frames))
        layers.set_times(usd_stage, 1, len(capture.manifest.frames))
    return textures


def _define_light(usd_stage: Usd.Stage, path: Sdf.Path, lit: RigLight, capture: Capture, folder: Path,
                  extent: np.ndarray, outside: dict[str, float]) -> tuple[_Emission, Path | None]:
    """Define one light without its intensity; return what it emits, and its texture where it has one."""
    light, space = lit.light, linear_space(capture.manifest.color_space)
    where = f"{capture.folder / FILE_NAME}: frames[{lit.frames[0] - 1}].light"
    if isinstance(light, DistantLight | PointLight | ExtendedLight):
        outside[lit.images[0]] = outside_gamut(light, space)
    if isinstance(light, DistantLight):
        distant = _define_distant(usd_stage, path, light.direction, 0.0, extent)
        return _Emission(distant, *light_colour(light.irradiance, space)), None
    if isinstance(light, ExtendedLight):
        power = np.array(light.radiance) * np.array(light.solid_angle)[:, None]
        vector = np.array(light.directions).T @ power  # [3, channels] vector irradiance
        mean = vector.sum(axis=1) / power.sum()
        length = float(np.linalg.norm(mean))
        if length < 0.5:  # a cone beyond a hemisphere
            raise AssetError(f"{where}: an extended light that surrounds the object is no light of a rig: give it as an environment")
        angle = 2 * math.degrees(math.acos(min(2 * length - 1, 1.0)))
        distant = _define_distant(usd_stage, path, mean / length, angle, extent)
        irradiance = np.maximum((mean / length) @ vector, 0)
        return _Emission(distant, *light_colour(tuple(irradiance.tolist()), space)), None
    if isinstance(light, PointLight):
        if not capture.camera.metric:
            raise AssetError(f"{where}: a near light stands at a place in metres, and the camera gives no scale: "
                             "its rig cannot be exported")
        return _define_point(usd_stage, path, light, space), None
    texture = folder / f"{RIG}_{lit.frames[0]:04d}.exr"
    if isinstance(light, EnvironmentLight):
        write_dome_texture(capture.file(light.image), texture, clipped=capture.clipped if capture.pixels.clip_negative else None,
                           outside=outside)
    elif light.axis == "full":
        return _Emission(define_dome(usd_stage, path, None), 1.0, (1.0, 1.0, 1.0)), None
    else:
        write_radiance(_gradient(light), texture)
    return _Emission(define_dome(usd_stage, path, f"./{texture.name}"), 1.0, (1.0, 1.0, 1.0)), texture


def _define_distant(usd_stage: Usd.Stage, path: Sdf.Path, direction: Sequence[float] | np.ndarray, angle: float,
                    extent: np.ndarray) -> UsdLux.DistantLight:
    """Define a distant light from its direction, which points to the light, and its angular diameter in degrees."""
    prim = UsdLux.DistantLight.Define(usd_stage, path)
    prim.CreateAngleAttr(angle)
    distance = DISPLAY_DISTANCE * float(np.linalg.norm(extent[1] - extent[0]))
    _place(prim, extent.mean(axis=0) + distance * np.asarray(direction), direction)
    return prim


def _define_point(usd_stage: Usd.Stage, path: Sdf.Path, light: PointLight, space: str) -> _Emission:
    unit = UsdGeom.GetStageMetersPerUnit(usd_stage)
    prim = UsdLux.SphereLight.Define(usd_stage, path)
    prim.CreateRadiusAttr(POINT_RADIUS_M / unit)
    prim.CreateTreatAsPointAttr(True)
    prim.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(prim, Usd.TimeCode.Default()))
    axis = np.array(light.axis or (0.0, 0.0, -1.0))
    _place(prim, np.array(light.position_m) / unit, -axis)
    if light.anisotropy:
        UsdLux.ShapingAPI.Apply(prim.GetPrim()).CreateShapingFocusAttr(light.anisotropy)
    intensity, color = light_colour(light.intensity, space)
    return _Emission(prim, 4 * intensity / unit**2, color)


def _place(prim: UsdGeom.Xformable, position: np.ndarray, backwards: Sequence[float] | np.ndarray) -> None:
    """Put a light at a position; it shines along its -z, so that its +z is `backwards`."""
    xformable = UsdGeom.Xformable(prim)
    xformable.AddTranslateOp().Set(Gf.Vec3d(*map(float, position)))
    rotation = Gf.Rotation(Gf.Vec3d(0, 0, 1), Gf.Vec3d(*map(float, backwards)))
    xformable.AddOrientOp(UsdGeom.XformOp.PrecisionFloat).Set(Gf.Quatf(rotation.GetQuat()))


def _set_emission(emission: _Emission, lit: RigLight, frame_count: int) -> None:
    """Write colour and intensity, which is 0 at the frames that the light does not light, and the images that it does."""
    light = UsdLux.LightAPI(emission.prim.GetPrim())
    light.CreateColorAttr(Gf.Vec3f(*emission.color))
    if not isinstance(emission.prim, UsdLux.DomeLight):
        light.CreateNormalizeAttr(True)
    intensity = light.CreateIntensityAttr(emission.intensity)
    codes = {code for frame in lit.frames for code in (frame - 1, frame, frame + 1)} | {1}
    for code in sorted(codes):
        if 1 <= code <= frame_count:
            intensity.Set(emission.intensity if code in lit.frames else 0.0, code)
    prim = emission.prim.GetPrim()
    prim.SetDisplayName(lit.images[0])
    for name, kind, value in (("image", Sdf.ValueTypeNames.String, lit.images[0]), ("frame", Sdf.ValueTypeNames.Int, lit.frames[0]),
                              ("intensity", Sdf.ValueTypeNames.Float, emission.intensity)):
        prim.CreateAttribute(f"userProperties:relit:{name}", kind, custom=True).Set(value)
    prim.SetCustomDataByKey("relit:images", Vt.StringArray(lit.images))
    if isinstance(lit.light, GradientLight) and lit.light.polarization != "none":
        prim.SetCustomDataByKey("relit:polarization", lit.light.polarization)


def _gradient(light: GradientLight) -> np.ndarray:
    """Return the radiance of a gradient, [rows, cols, 3] float32, as a lat-long map."""
    v, u = np.meshgrid((np.arange(GRADIENT_ROWS) + 0.5) / GRADIENT_ROWS, (np.arange(2 * GRADIENT_ROWS) + 0.5) / (2 * GRADIENT_ROWS),
                       indexing="ij")
    direction = {"x": np.sin(2 * np.pi * u) * np.sin(np.pi * v), "y": np.cos(np.pi * v), "z": -np.cos(2 * np.pi * u) * np.sin(np.pi * v)}
    radiance = (1 + light.sign * direction[light.axis]) / 2
    return np.repeat(radiance[..., None], 3, axis=2).astype(np.float32)
