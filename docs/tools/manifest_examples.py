"""An example of every object of a capture.json, which docs/manifest.md shows."""

from typing import Any

from stage.capture.camera import Camera, Distortion, OtherCamera, StereoImages
from stage.capture.light import (
    ContinuousWave,
    DistantLight,
    EnvironmentLight,
    ExtendedLight,
    FullLight,
    GradientLight,
    LaserPlane,
    LaserRay,
    OffLight,
    PointLight,
    Pulsed,
)
from stage.capture.manifest import SCHEMA, Frame, Manifest
from stage.capture.projector import Projector, UncalibratedProjector
from stage.model import Strict
from stage.patterns.base import UniformPattern
from stage.patterns.binary import BinaryPattern, XorPattern
from stage.patterns.kary import KaryPattern
from stage.patterns.modulated import ModulatedPattern
from stage.patterns.phase import PhasePattern
from stage.patterns.ramp import RampPattern

Example = dict[str, Any]

_DISTORTION: Example = {"model": "brown_conrady", "k": [-0.12, 0.03, 0.0], "p": [0.0004, -0.0002]}
_ORTHOGRAPHIC: Example = {"projection": "orthographic", "resolution": [1024, 768], "pixel_size_m": 0.0002, "surface_z_m": 0.0}
_DISTANT: Example = {"type": "distant", "direction": [0.36, 0.48, 0.8], "irradiance": [3.1, 3.1, 3.0]}
_CROSSED: Example = {**_DISTANT, "polarization": "cross"}
_PARALLEL: Example = {**_DISTANT, "polarization": "parallel"}
_WHITE: Example = {"code": "white"}
_RAY: Example = {"type": "ray", "origin_m": [0.15, 0.0, 0.0], "direction": [-0.2, 0.0, -1.0]}
_STEREO: Example = {"images": ["right_0.png"]}
_OTHER: Example = {
    "name": "right", "resolution": [1280, 1024], "focal_px": [1500.0, 1500.0], "principal_px": [641.2, 510.8], "distortion": _DISTORTION,
    "camera_from_other": [[1, 0, 0, 0.12], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "depth_sigma": 0.002}
_CONTINUOUS: Example = {"type": "cw", "modulation_hz": 60_000_000, "reference_phase_rad": 1.570796, "source_m": [0.02, 0.0, 0.0]}

EXAMPLES: dict[type[Strict], tuple[Example, ...]] = {
    Manifest: ({
        "schema": SCHEMA, "name": "statue", "color_space": "srgb_texture", "camera": _ORTHOGRAPHIC,
        "projector": {"resolution": [1280, 800]},
        "mask": "mask.png", "dark": "dark.png", "flat": "card.png", "saturation": 0.98, "irradiance_scale": "relative",
        "frames": [{"image": "000.png", "light": _DISTANT}],
    }, {
        "schema": SCHEMA, "name": "statue", "color_space": "srgb_texture", "camera": _ORTHOGRAPHIC, "exposure_from": "exif",
        "assumed": ["color_space: the images have 8 bits and were taken as sRGB"],
        "color_matrix": [[1.62, -0.55, -0.07], [-0.2, 1.58, -0.38], [0.03, -0.48, 1.45]],
        "frames": [{"image": "000.jpg", "light": _DISTANT}],
    }, {
        "schema": SCHEMA, "name": "statue", "camera": _ORTHOGRAPHIC, "polarizer_leak": 0.01,
        "frames": [{"image": "000_cross.exr", "light": _CROSSED}, {"image": "000_parallel.exr", "light": _PARALLEL}],
    }, {
        "schema": SCHEMA, "name": "head", "color_space": "srgb_texture",
        "camera": {"projection": "perspective", "resolution": [1280, 1024], "focal_px": [1500.0, 1500.0]}, "other_cameras": [_OTHER],
        "frames": [{"image": "left_0.png", "stereo": _STEREO}],
    }),
    Camera: (
        {"projection": "perspective", "resolution": [1024, 768], "focal_px": [2100.0, 2100.0], "principal_px": [512.5, 384.5],
         "distortion": _DISTORTION, "surface_z_m": -0.8,
         "world_from_camera": [[1, 0, 0, 0], [0, 1, 0, 1.5], [0, 0, 1, 0.8], [0, 0, 0, 1]]},
        _ORTHOGRAPHIC,
    ),
    Distortion: (_DISTORTION,),
    Projector: ({
        "resolution": [1280, 800], "focal_px": [1750.0, 1750.0], "principal_px": [640.5, 790.0],
        "distortion": {"model": "brown_conrady", "k": [-0.05, 0.0, 0.0]},
        "camera_from_projector": [[0.96, 0, -0.28, 0.2], [0, 1, 0, 0.01], [0.28, 0, 0.96, 0.05], [0, 0, 0, 1]], "depth_sigma": 0.002,
        "response": [0.0, 0.05, 0.22, 0.53, 1.0], "crosstalk": [[0.95, 0.04, 0.01], [0.06, 0.9, 0.04], [0.0, 0.05, 0.95]],
    },),
    UncalibratedProjector: ({"resolution": [1280, 800]}, {"resolution": [1280, 800], "response": [0.0, 0.05, 0.22, 0.53, 1.0],
                                                          "crosstalk": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}),
    Frame: ({"image": "000.png", "exposure_s": 0.0125, "light": _DISTANT}, {"image": "pattern_00.png", "pattern": _WHITE},
            {"image": "000_cross.exr", "light": _CROSSED,
             "color_matrix": [[1.7, -0.6, -0.1], [-0.2, 1.6, -0.4], [0.0, -0.5, 1.5]]},
            {"image": "spot_00.png", "laser": _RAY}, {"image": "phase_090.npy", "tof": _CONTINUOUS},
            {"image": "left_0.png", "stereo": _STEREO}),
    OtherCamera: (_OTHER,),
    StereoImages: (_STEREO,),
    DistantLight: (_DISTANT, _CROSSED),
    PointLight: ({"type": "point", "position_m": [0.2, 0.1, 0.3], "intensity": [0.5, 0.5, 0.48], "axis": [-0.2, -0.1, -0.3],
                  "anisotropy": 1.0, "polarization": "parallel"},),
    ExtendedLight: ({"type": "extended", "directions": [[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]], "radiance": [[4.0, 4.0, 4.0], [2.0, 2.0, 2.0]],
                     "solid_angle": [0.01, 0.01]},),
    GradientLight: ({"type": "gradient", "axis": "x", "sign": -1, "polarization": "cross"},),
    EnvironmentLight: ({"type": "environment", "image": "probe.exr"},),
    OffLight: ({"type": "off"},),
    FullLight: ({"type": "full"},),
    BinaryPattern: ({"code": "gray", "axis": "column", "bit": 10, "bits": 11, "stripe_px": 1, "inverse": True},),
    XorPattern: ({"code": "xor", "axis": "column", "bit": 10, "bits": 11, "base_bit": 1, "stripe_px": 1, "inverse": False},),
    KaryPattern: ({"code": "kary", "axis": "column", "base": 3, "digit": 6, "digits": 7, "stripe_px": 1, "reflected": True,
                   "levels": [0.0, 0.5, 1.0]},
                  {"code": "kary", "axis": "row", "base": 3, "digit": 0, "digits": 7, "colors": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}),
    RampPattern: ({"code": "ramp", "axis": "column", "direction": "up"},),
    PhasePattern: ({"code": "phase", "axis": "column", "period_px": 18.0, "step": 1, "steps": 4, "offset_rad": -1.5707963},),
    ModulatedPattern: ({"code": "modulated", "axis": "column", "period_px": 1280.0, "step": 1, "steps": 3, "carrier_period_px": 8.0,
                        "carrier_step": 2, "carrier_steps": 3, "offset_rad": -1.5707963},),
    UniformPattern: (_WHITE,),
    LaserRay: (_RAY,),
    LaserPlane: ({"type": "plane", "point_m": [0.15, 0.0, 0.0], "normal": [1.0, 0.0, -0.2], "accuracy_deg": 0.05, "accuracy_m": 0.0001},),
    ContinuousWave: (_CONTINUOUS,),
    Pulsed: ({"type": "pulsed", "bin_s": 9.1e-11, "start_s": -1e-9, "pulses": 100000, "first_photon_only": True, "count_scale": 10.0,
              "source_m": [0.02, 0.0, 0.0]},),
}
"""Examples of each model; together they have every field."""
