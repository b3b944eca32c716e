"""Captures of the rig: which frames each pattern set has, and their pictures as sums over the transport."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import rig_scene
import rig_transport
from rig_scene import HEIGHT, WIDTH, Rig
from rig_transport import Transport

from stage.patterns.binary import binary_patterns, xor_patterns
from stage.patterns.codes import Pattern
from stage.patterns.kary import kary_patterns
from stage.patterns.modulated import ModulatedPattern, modulated_patterns
from stage.patterns.phase import micro_patterns, phase_patterns
from stage.patterns.ramp import ramp_patterns

STRIPE_SIGMA_PX = 0.9
STRIPE_STEP_PX = 2
PHASE_PERIODS_PX = (16, 18, 21)
XOR_STRIPE_PX, XOR_PHASE_STRIPE_PX = 2, 4  # of one pixel the camera, whose pixels are as large, resolves too little
GRAY_STRIPE_PX = 8  # half a period of the phase that it numbers: a stripe's edge is never a period's alone


class RigFrame(NamedTuple):
    """One picture and its manifest entry."""

    entry: dict  # {"pattern": …} or {"laser": …}
    radiance: np.ndarray  # [rows, cols] float32, without camera noise


PATTERNS: dict[str, Callable[[], tuple[Pattern, ...]]] = {
    "gray": lambda: binary_patterns(WIDTH, "column"),
    "gray_rows": lambda: binary_patterns(HEIGHT, "row"),
    "gray_both": lambda: (*binary_patterns(WIDTH, "column", references=False), *binary_patterns(HEIGHT, "row")),
    "ternary": lambda: kary_patterns(WIDTH, "column", base=3),
    "ramp": lambda: ramp_patterns("column"),
    "phase": lambda: phase_patterns("column", PHASE_PERIODS_PX, 4),
    "gray_phase": lambda: (*phase_patterns("column", PHASE_PERIODS_PX[:1], 4),
                           *binary_patterns(WIDTH, "column", stripe_px=GRAY_STRIPE_PX)),
    "long_phase": lambda: phase_patterns("column", (WIDTH,), 8),
    "micro": lambda: micro_patterns(WIDTH, "column"),
    "xor": lambda: xor_patterns(WIDTH, "column", stripe_px=XOR_STRIPE_PX),
    "xor_phase": lambda: (*phase_patterns("column", PHASE_PERIODS_PX[:1], 4),
                          *xor_patterns(WIDTH, "column", stripe_px=XOR_PHASE_STRIPE_PX)),
    "modulated": lambda: modulated_patterns("column", rig_transport.WAVE_PERIOD_PX,
                                            carrier_period_px=rig_transport.CARRIER_PERIOD_PX),
}  # fmt: skip
LASERS = ("spots", "planes")
SETS = (*PATTERNS, *LASERS)


def make_frames(name: str, rig: Rig, transport: Transport) -> list[RigFrame]:
    """Return the frames of one set.

    Raises:
        ValueError: laser planes of a projector whose columns are bent by distortion.
    """
    shape = (rig.camera.height, rig.camera.width)

    def frame(entry: dict, lit: np.ndarray) -> RigFrame:
        return RigFrame(entry, (lit + transport.ambient).astype(np.float32).reshape(shape))

    black = frame({"pattern": {"code": "black"}}, np.zeros_like(transport.ambient))
    if name == "spots":
        lasers = [_ray(rig, u, v) for u, v in rig_transport.spot_positions()]
        return [black, *(frame({"laser": laser}, transport.spots[:, i]) for i, laser in enumerate(lasers))]
    if name == "planes":
        if rig.projector.distortion is not None:
            raise ValueError("columns of a distorted projector are not planes")
        at = np.arange(STRIPE_STEP_PX / 2, WIDTH, STRIPE_STEP_PX)  # between two columns, where a blurred stripe stays symmetric
        profiles = np.exp(-0.5 * ((np.arange(WIDTH) + 0.5 - at[:, None]) / STRIPE_SIGMA_PX) ** 2)
        lit = transport.columns @ profiles.T.astype(np.float32)
        return [black, *(frame({"laser": _plane(rig, u)}, lit[:, i]) for i, u in enumerate(at))]
    patterns = PATTERNS[name]()
    return [frame({"pattern": pattern.model_dump(mode="json", exclude_none=True)}, light(pattern, transport)) for pattern in patterns]


def light(pattern: Pattern, transport: Transport) -> np.ndarray:  # -> [pixels]
    """Return the radiance that the projector adds to the ambient light."""
    if isinstance(pattern, ModulatedPattern):
        return transport.waves @ _waves(pattern)
    of = transport.rows if getattr(pattern, "axis", "column") == "row" else transport.columns
    extent = of.shape[1]
    u = np.arange(extent) + 0.5
    return of @ pattern.level(u, np.zeros_like(u), extent).astype(np.float32)


def _waves(pattern: ModulatedPattern) -> np.ndarray:
    """Return the weights of Transport.waves."""
    if (pattern.period_px, pattern.carrier_period_px) != (rig_transport.WAVE_PERIOD_PX, rig_transport.CARRIER_PERIOD_PX):
        raise ValueError("the transport holds the waves of one modulated pattern only")

    def of(step: int, steps: int) -> np.ndarray:
        shift = 2 * np.pi * step / steps
        return np.array([0.5, 0.5 * np.cos(shift), 0.5 * np.sin(shift)])

    return np.outer(of(pattern.step, pattern.steps), of(pattern.carrier_step, pattern.carrier_steps)).ravel().astype(np.float32)


def _numbers(vector: np.ndarray) -> list[float]:
    return [round(float(x), 9) for x in vector]


def _ray(rig: Rig, u: float, v: float) -> dict:
    origin, direction = rig_scene.projector_ray(rig.projector, u, v)
    return {"type": "ray", "origin_m": _numbers(origin), "direction": _numbers(direction)}


def _plane(rig: Rig, u: float) -> dict:
    origin, top = rig_scene.projector_ray(rig.projector, u, 0.0)
    _, bottom = rig_scene.projector_ray(rig.projector, u, HEIGHT)
    normal = np.cross(top, bottom)
    return {"type": "plane", "point_m": _numbers(origin), "normal": _numbers(normal / np.linalg.norm(normal))}
