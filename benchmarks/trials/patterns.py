"""Depth under projected patterns: every code on a textured scene, and what its model leaves out: gamma, fog, mirrors, wrong manifests."""

import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trials.trial import Trial
from service.depth.depth import depth
from service.requests.depth import DepthRequest
from stage.errors import StageError
from stage.patterns.binary import binary_patterns, xor_patterns
from stage.patterns.codes import Pattern
from stage.patterns.kary import kary_patterns, palette
from stage.patterns.modulated import modulated_patterns
from stage.patterns.phase import micro_patterns, phase_patterns
from stage.patterns.ramp import ramp_patterns
from tests.scenes.projected import Ball, Light, Wall, World, trace, write_capture

WIDTH, HEIGHT, NARROW = 320, 240, 256
SHELF = (Wall((0, 0, -1.5), (-0.25, 0.1, 1), 0.75, texture=0.5), Ball((-0.15, 0.05, -1.15), 0.12, 0.8, texture=0.3),
         Ball((0.2, -0.12, -1.3), 0.15, 0.5), Wall((0.12, 0.14, -1.2), (0.2, -0.3, 1), 0.6, half_m=(0.09, 0.07)))
MIRRORS = (Wall((0, 0, -1.5), (-0.1, 0.1, 1), 0.7, texture=0.3), Wall((0, -0.3, 0), (0, 1, 0), 0.5, texture=0.2),
           Ball((-0.06, -0.1, -1.2), 0.15, mirror=True))
TWICE = 6
"""Number of the frame that shows the pattern of the one before."""
MOVED_M = 0.024
"""By how much a ball moves during the patterns."""
DRIFT_PX = 2.0
"""By how much a camera drifts during the patterns."""
WIDE, PIXEL = World(shapes=()).rig.camera[0], 1 / World(shapes=()).rig.camera_focal
"""Columns of the camera, and the side of a pixel at 1 m."""
NEAR_M = -1.08
WIRES = (Wall((0, 0, -1.35), (0.2, 0.1, 1), 0.6, texture=0.3), *(
    Wall((-0.28 + 0.08 * number, 0, NEAR_M), (0, 0, 1), 0.5, half_m=(width * PIXEL * -NEAR_M / 2, 0.5))
    for number, width in enumerate((0.4, 0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8))))
"""Wires of some widths in pixels before a wall."""
GRAY = binary_patterns(WIDTH, "column")
PHASE_GRAY = (*phase_patterns("column", (16,), 4), *binary_patterns(WIDTH, "column", stripe_px=8))
CODES: dict[str, Sequence[Pattern]] = {
    "Gray, inverses": GRAY,
    "Gray, white and black": binary_patterns(WIDTH, "column", inverses=False),
    "Gray, both axes": (*binary_patterns(WIDTH, "column"), *binary_patterns(HEIGHT, "row", references=False)),
    "binary": binary_patterns(WIDTH, "column", code="binary"),
    "binary, white and black": binary_patterns(WIDTH, "column", code="binary", inverses=False),
    "XOR": xor_patterns(WIDTH, "column"),
    "k-ary, reflected": kary_patterns(WIDTH, "column", base=3),
    "k-ary, plain": kary_patterns(WIDTH, "column", base=3, reflected=False),
    "colours, base 4, reflected": kary_patterns(WIDTH, "column", base=4, colors=palette(4)),
    "colours, base 3, plain": kary_patterns(WIDTH, "column", base=3, reflected=False, colors=palette(3)),
    "ramps": ramp_patterns("column"),
    "phase 16/18/21, 3 steps": phase_patterns("column", (16, 18, 21), 3),
    "phase 16/18/21, 4 steps": phase_patterns("column", (16, 18, 21), 4),
    "phase 16, 4 steps, Gray": PHASE_GRAY,
    "micro": micro_patterns(WIDTH, "column"),
    "modulated": modulated_patterns("column", 1.1 * WIDTH),
}
ONE = phase_patterns("column", (WIDTH,), 3)
BENT = {"phase 16/18/21, 3 steps": CODES["phase 16/18/21, 3 steps"],
        "phase 16, 3 steps, Gray": (*phase_patterns("column", (16,), 3), *binary_patterns(WIDTH, "column", stripe_px=8)),
        "k-ary, reflected": CODES["k-ary, reflected"]}
PHASE_BOTH = (*phase_patterns("column", (16, 18, 21), 4), *phase_patterns("row", (16, 18, 21), 4))
PROJECTORS = {"": (0.0, 0.0, 1.0), ", projector declared 1° aside": (1.0, 0.0, 1.0), ", projector declared 1° tilted": (0.0, 1.0, 1.0),
              ", focal length declared 4 % longer": (0.0, 0.0, 1.04)}
"""Yaw and roll in degrees and the factor of the focal length by which the projector is declared wrongly."""
GAMMA = 2.2
BELOW: dict[str, dict[str, Any]] = {"30 % of the light": {"scattered": 0.3}, "90 % of the light": {"scattered": 0.9},
                                    "70 % of the light 2 px far, scattered twice,": {"scattered": 0.7, "scatter_px": 2.0, "flights": 2}}
"""Parts of the light that run below the surface, 6 px far where nothing else is said."""
NOISES = {"": (0.003, 10000.0), ", weak light": (0.006, 2500.0)}
"""Read noise as a part of full scale, and electrons at full scale."""
NOISY, UNSHARP_PX = 0.02, 3.0
"""Noise of cameras that are noisier than declared, and deviation of a projector's focus in its pixels."""


def trials(data: Path | None) -> Iterator[Trial]:
    """Yield a trial for every code, and for every scene that is out of their model."""
    light = trace(World(shapes=SHELF))
    for words, (read, electrons) in NOISES.items():
        world = World(shapes=SHELF, read_noise=read, electrons=electrons)
        for name in CODES if not words else ("Gray, inverses", "binary, white and black", "k-ary, plain", "ramps",
                                                    "phase 16/18/21, 4 steps", "phase 16, 4 steps, Gray"):
            yield _run(f"{name}{words}", True, world, CODES[name], light)
    for name in ("Gray, inverses", "phase 16, 4 steps, Gray", "phase 16/18/21, 3 steps", "ramps", "modulated"):
        yield _run(f"{name}, noise of {100 * NOISY:g} % declared as {100 * NOISES[''][0]:g}", False, World(shapes=SHELF, read_noise=NOISY),
                   CODES[name], light, read_noise=NOISES[""][0])
    yield _run("Gray, inverses, images of points", False, World(shapes=SHELF, samples=1, blur_px=0.0), GRAY)
    response = (np.linspace(0, 1, 256)**GAMMA).tolist()
    for name, patterns in BENT.items():
        bent = World(shapes=SHELF, gamma=GAMMA)
        yield _run(f"{name}, gamma {GAMMA} declared", True, bent, patterns, light, response=response)
        if not name.startswith("k-ary"):
            yield _run(f"{name}, gamma {GAMMA} not declared", False, bent, patterns, light)
    yield _run(f"ramps, gamma {GAMMA} not declared", False, World(shapes=SHELF, gamma=GAMMA), CODES["ramps"], light)
    for name in ("k-ary, reflected", "colours, base 4, reflected", "colours, base 3, plain"):
        yield _run(f"{name}, out of focus by {UNSHARP_PX:g} px", False, World(shapes=SHELF, blur_px=UNSHARP_PX), CODES[name], light)
    turned = kary_patterns(WIDTH, "column", base=4, colors=[color[::-1] for color in palette(4)])
    name = "colours, base 4, reflected"
    yield _run(f"{name}, red and blue exchanged", False, World(shapes=SHELF), turned, light, declared=CODES[name])
    for fog in (0.5, 1.5, 3.0):
        yield _run(f"Gray in fog of {fog:g} / m", False, World(shapes=SHELF, fog=fog, light=0.5 + fog, samples=2), GRAY)
    yield _run("phase 16, 4 steps, Gray, in fog of 3 / m", False, World(shapes=SHELF, fog=3.0, light=3.5, samples=2), PHASE_GRAY)
    seen = trace(World(shapes=MIRRORS))
    for name in ("Gray, inverses", "Gray, both axes", "phase 16, 4 steps, Gray"):
        yield _run(f"{name}, before a mirror ball", False, World(shapes=MIRRORS), CODES[name], seen)
    for name, (yaw, roll, zoom) in PROJECTORS.items():
        turn = np.eye(4)
        turn[:3, :3] = _turn(0, 2, yaw) @ _turn(1, 0, roll)
        rig = World(shapes=SHELF).rig
        for refined in (False, True) if name else (False,):
            yield _run(f"phase 16/18/21, both axes{name}{', refined' if refined else ''}", not name, World(shapes=SHELF), PHASE_BOTH, light,
                       refined=refined, camera_from_projector=(rig.pose @ turn).tolist(), focal_px=[rig.projector_focal * zoom] * 2)
    for name, (patterns, change) in wrong().items():
        yield _run(name, False, World(shapes=SHELF), patterns, light, declared=[change(pattern) for pattern in patterns])
    yield _run(f"phase {WIDTH}, 3 steps", True, World(shapes=SHELF), ONE, light)
    yield _run(f"phase {WIDTH}, 3 steps, gamma {GAMMA} not declared", False, World(shapes=SHELF, gamma=GAMMA), ONE, light)
    for name in ("Gray, inverses", "phase 16/18/21, 4 steps", f"phase {WIDTH}, 3 steps"):
        yield _run(f"{name}, projector declared as {NARROW} columns", False, World(shapes=SHELF), CODES.get(name, ONE), light,
                   resolution=[NARROW, HEIGHT], principal_px=[NARROW / 2, HEIGHT / 2])
    for name, part in (("phase 16, 4 steps, Gray", 0.2), ("phase 16/18/21, 3 steps", 0.3), ("Gray, white and black", 0.45),
                       (f"phase {WIDTH}, 3 steps", 0.1), (f"phase {WIDTH}, 3 steps", 0.3)):
        yield _run(f"{name}, {part:g} of the next pattern in each frame", False, World(shapes=SHELF, mixed=part), CODES.get(name, ONE),
                   light)

    for name in ("Gray, white and black", "phase 16, 4 steps, Gray"):
        code = list(CODES[name])
        yield _run(f"{name}, one pattern shown twice in place of the next", False, World(shapes=SHELF),
                   [*code[:TWICE], code[TWICE - 1], *code[TWICE + 1 :]], light, declared=code)
    for name in ("Gray, inverses", "phase 16, 4 steps, Gray", "phase 16/18/21, 4 steps"):
        moments = [trace(World(shapes=(SHELF[0], SHELF[1]._replace(center_m=(x, 0.05, -1.15)), *SHELF[2:])))
                   for x in np.linspace(-0.15 - MOVED_M / 2, -0.15 + MOVED_M / 2, len(CODES[name]))]
        yield _run(f"{name}, a ball moves by {1e3 * MOVED_M:g} mm", False, World(shapes=SHELF), CODES[name], light, moments=moments)
    for name in ("Gray, inverses", "Gray, white and black", "binary", "k-ary, reflected", "k-ary, plain", "phase 16, 4 steps, Gray",
                 "phase 16/18/21, 4 steps"):
        yield _run(f"{name}, the camera drifts by {DRIFT_PX:g} px", False, World(shapes=SHELF), CODES[name], light,
                   aside=[(0.0, right) for right in np.linspace(0, DRIFT_PX, len(CODES[name]))])
    seen, bare = trace(World(shapes=WIRES, samples=6)), trace(World(shapes=WIRES[:1], samples=1)).depth
    column = (np.arange(WIDE) + 0.5 - WIDE / 2) * PIXEL  # of the plane 1 m away, metres
    beside = np.min([np.abs(column - wire.point_m[0] / -NEAR_M) for wire in WIRES[1:]], axis=0) < 1.5 * PIXEL
    beside = np.broadcast_to(beside, bare.shape) & np.isfinite(bare)
    for name in ("Gray, inverses", "phase 16, 4 steps, Gray", "phase 16/18/21, 4 steps", "micro"):
        yield _run(f"{name}, on wires of 0.4 to 1.8 px", False, World(shapes=WIRES), CODES[name],
                   seen._replace(depth=bare), others=[np.full_like(bare, -NEAR_M)], near=beside)
    for name in ("phase 16/18/21, 4 steps", "phase 16, 4 steps, Gray", "micro"):
        for words, below in BELOW.items():
            yield _run(f"{name}, {words} below the surface", False, World(shapes=SHELF, **below), CODES[name], light)


def _turn(first: int, second: int, degrees: float) -> np.ndarray:
    matrix, angle = np.eye(3), np.radians(degrees)
    matrix[[first, second], [first, second]], matrix[first, second], matrix[second, first] = np.cos(angle), np.sin(angle), -np.sin(angle)
    return matrix


def _changed(**fields: Callable[[Pattern], object]) -> Callable[[Pattern], Pattern]:
    return lambda pattern: pattern.model_copy(update={name: value(pattern) for name, value in fields.items() if hasattr(pattern, name)})


def wrong() -> dict[str, tuple[Sequence[Pattern], Callable[[Pattern], Pattern]]]:
    """Return what is shown, and how each pattern is declared in its place."""
    return {
        "Gray, inverses declared for patterns": (GRAY, _changed(inverse=lambda p: not getattr(p, "inverse", False))),
        "Gray, columns declared as rows": (GRAY, _changed(axis=lambda p: "row")),
        "Gray, bits declared backwards": (GRAY, _changed(bit=lambda p: getattr(p, "bits", 1) - 1 - getattr(p, "bit", 0))),
        "Gray declared as binary": (GRAY, _changed(code=lambda p: "binary" if p.code == "gray" else p.code)),
        "Gray, bits 5 and 6 exchanged": (GRAY, _changed(bit=lambda p: {5: 6, 6: 5}.get(getattr(p, "bit", 0), getattr(p, "bit", 0)))),
        **{f"k-ary, {name}, declared otherwise": (CODES[f"k-ary, {name}"], _changed(reflected=lambda p: not getattr(p, "reflected", False)))
           for name in ("reflected", "plain")},
        "phase 16, 4 steps, Gray, steps backwards": (PHASE_GRAY, _changed(step=lambda p: -getattr(p, "step", 0) % getattr(p, "steps", 1))),
        "phase 16, 4 steps, Gray, a step late": (PHASE_GRAY, _changed(step=lambda p: (getattr(p, "step", 0) + 1) % getattr(p, "steps", 1))),
        **{f"{name}, {words}": (CODES.get(name, ONE), change)
           for name in (f"phase {WIDTH}, 3 steps", "phase 16/18/21, 4 steps")
           for words, change in (("steps backwards", _changed(step=lambda p: -getattr(p, "step", 0) % getattr(p, "steps", 1))),
                                 ("offset declared -π/2", _changed(offset_rad=lambda p: -np.pi / 2)))},
        "phase 16/18/21, 4 steps, 18 px declared as 17.5": (
            CODES["phase 16/18/21, 4 steps"], _changed(period_px=lambda p: 17.5 if getattr(p, "period_px", 0) == 18 else p.period_px)),
        "phase 16, 4 steps, Gray, declared as 17 px": (PHASE_GRAY, _changed(period_px=lambda p: 17.0)),
    }


def _run(name: str, in_model: bool, world: World, patterns: Sequence[Pattern], light: Light | None = None,
         declared: Sequence[Pattern] | None = None, *, refined: bool = False, moments: Sequence[Light] | None = None,
         aside: Sequence[tuple[float, float]] | None = None,
         others: Sequence[np.ndarray] = (), near: np.ndarray | None = None, read_noise: float | None = None, **projector: object) -> Trial:
    """Return what `relit depth` says of one capture; every pixel that the projector lights has a truth.

    `others`: further depths [rows, cols] that are right. `near`: the pixels [rows, cols] bool that count; None: all. `read_noise`: as it is
    declared; None: that of the world.
    """
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "capture"
        light = write_capture(capture, world, patterns, light=light,
                              declared=declared, moments=moments, aside=aside, **projector)
        known = (light.lit if near is None else near) & np.isfinite(light.depth)
        try:
            found = depth(DepthRequest(capture=capture, out=Path(folder) / "out", read_noise=read_noise or world.read_noise,
                                       photon_gain=1 / world.electrons, refine_projector=refined))
        except StageError as error:
            nothing = np.zeros(int(known.sum()))
            return Trial(name, in_model, nothing, nothing, nothing, nothing > 0, "mm", str(error).split(": ", 1)[-1])
    maps = found.maps
    assert maps.sigma is not None and maps.confidence is not None
    error = np.min([np.abs(maps.depth - truth) for truth in (light.depth, *others)], axis=0)
    return Trial(name, in_model, 1e3 * error[known], 1e3 * maps.sigma[known], maps.confidence[known],
                 maps.mask[known], "mm", "; ".join(found.warnings))
