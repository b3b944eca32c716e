"""Scenes and stages that are captured in tests."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from service.acquisition.checks.expectation import Fault, FaultKind
from service.acquisition.checks.judge import FULL_SCALE, Judge
from service.acquisition.plans.plan import Plan
from service.acquisition.plans.shots import Shot, shots_of
from service.twin.camera import AMBIENT, BLUR_PX, OVEREXPOSED, SHIFT_PX
from stage.capture.capture import Capture
from stage.formats import images
from stage.rig.rig import Rig
from tests.scenes.patched_rigs import loopback
from tests.scenes.rigs import write_rig
from tests.service.acquisition.test_acquire import posting
from tests.service.owl import OWL, block_mean
from tests.service.twin_program import twin_running

KINDS = (FaultKind.UNLIT, FaultKind.WRONG_LIGHT, FaultKind.DOUBLED, FaultKind.MOVED, FaultKind.CLIPPED, FaultKind.AMBIENT,
         FaultKind.UNSHARP)
VISIBLE = 0.3
"""Faults are put where a lamp gives this part of the mean light of a lamp: behind the object nothing tells a lamp from none."""

BRIGHT = 1.5
"""Ambient light of 0.8 of the mean picture goes where a lamp gives less than this: the prediction errs by more beside the brightest."""


class Scene(NamedTuple):
    """What each lamp lights."""

    radiance: np.ndarray  # [lamps, rows, cols, 3] float32, full scale 1
    directions: np.ndarray  # [lamps, 3]
    light: np.ndarray | None = None  # [lamps], the irradiance that the rig says of each; None: 1


@cache
def owl() -> Scene:
    """The shipped owl under lamps all around, at half its width."""
    names = sorted(OWL.glob("[0-9][0-9][0-9].exr"))
    directions = np.array([frame.light.direction for frame in Capture.open(OWL).manifest.frames])
    return Scene(np.stack([block_mean(images.read_pixels(name).astype(np.float32), 2) for name in names]) / 2.83, directions)


@cache
def relief(seed: int, rings: tuple[int, ...] = (12, 10, 8, 4)) -> Scene:
    """Textured bumps with cast shadows and a little gloss, under a dome of rings that a person has built."""
    random, (rows, cols) = np.random.default_rng(seed), (110, 130)
    y, x = np.mgrid[:rows, :cols].astype(np.float32)
    height = np.zeros((rows, cols), np.float32)
    for _ in range(10):
        radius, middle = random.uniform(8, 30), random.uniform(0.1, 0.9, 2) * (rows, cols)
        squared = ((y - middle[0]) ** 2 + (x - middle[1]) ** 2) / radius**2
        height = np.maximum(height, random.uniform(0.3, 0.9) * radius * np.sqrt(np.clip(1 - squared, 0, None)))
    height = ndimage.gaussian_filter(height, 1) + 3 * ndimage.gaussian_filter(random.normal(size=height.shape), 3)
    down, right = np.gradient(height)
    normal = np.dstack([-right, down, np.ones_like(height)])
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    texture = ndimage.gaussian_filter(random.normal(size=height.shape), 1.2)
    albedo = np.clip(0.45 + 0.15 * texture / texture.std(), 0.05, 0.95)[..., None] * random.uniform(0.5, 1, 3)
    directions = np.array([[np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)]
                           for count, degrees in zip(rings, np.linspace(18, 78, len(rings)), strict=True)
                           for up, around in zip(np.radians(degrees + random.normal(0, 1, count)),
                                                 2 * np.pi * (np.arange(count) + random.uniform()) / count, strict=True)])
    pictures = []
    for towards in directions:
        lit = np.ones(height.shape, dtype=bool)
        for step in range(1, int(min(60, 35 / towards[2]))):
            lit &= ndimage.shift(height, (towards[1] * step, -towards[0] * step), order=1, mode="nearest") <= height + step * towards[2]
        half = (towards + [0, 0, 1]) / np.linalg.norm(towards + [0, 0, 1])
        cosine = np.clip(normal @ towards, 0, None)
        pictures.append((cosine[..., None] * albedo + 0.1 * (normal @ half)[..., None] ** 40 * (cosine > 0)[..., None]) * lit[..., None])
    return Scene(np.array(pictures, dtype=np.float32) * 0.35, directions)


def rig_of(scene: Scene) -> Rig:
    """Return a rig of the lamps, whose brightness is driven."""
    return Rig.model_validate({"schema": "relit.rig/1", "name": "test", "color_space": "lin_rec709_scene", "lights": [
        {"name": f"L{index}", "type": "distant", "direction": (towards / np.linalg.norm(towards)).tolist(),
         "primaries": [{"name": "white", "irradiance": [light, light, light]}],
         "address": {"protocol": "sacn", "universe": 1, "channels": {"white": index + 1}}}
        for index, (towards, light) in enumerate(zip(
            scene.directions, np.ones(len(scene.directions)) if scene.light is None else scene.light, strict=True))]})


def shots_on(rig: Rig, tracking_every: int = 24) -> tuple[Shot, ...]:
    """Return the shots of a dark picture and of each lamp alone, with tracking pictures."""
    return shots_of(Plan.model_validate({"schema": "relit.plan/1", "tracking_every": tracking_every,
                                         "sequences": [{"take": "dark", "count": 2}, {"take": "olat"}]}), rig, None)


class NoisyCamera:
    """Takes pictures of a scene at the levels of shots."""

    def __init__(self, scene: Scene, seed: int, noise: float = 0.004) -> None:
        self._scene, self._random, self._noise = scene, np.random.default_rng(seed), noise
        self._previous: np.ndarray | None = None

    def take(self, shot: Shot, fault: FaultKind | None = None) -> np.ndarray:
        """Return [rows, cols, 3] of a shot, with a fault."""
        levels = shot.levels
        if fault is FaultKind.UNLIT:
            levels = np.zeros_like(levels)
        if fault is FaultKind.WRONG_LIGHT:
            levels = np.roll(levels, 1)
        if fault is FaultKind.AMBIENT:
            levels = levels + AMBIENT * 4 / len(levels)
        on = np.flatnonzero(levels)
        pixels = np.tensordot(levels[on].astype(np.float32), self._scene.radiance[on], 1)
        if fault is FaultKind.MOVED:
            pixels = np.roll(pixels, SHIFT_PX, axis=1)
        if fault is FaultKind.UNSHARP:
            pixels = ndimage.gaussian_filter(pixels, (BLUR_PX, BLUR_PX, 0))
        if fault is FaultKind.CLIPPED:
            pixels = pixels * OVEREXPOSED
        shot_noise = np.sqrt(np.maximum(pixels, 0) / 4 + 1 / 16)
        taken = np.clip(pixels + self._noise * shot_noise * self._random.standard_normal(pixels.shape, np.float32), None, 1)
        if fault is FaultKind.DOUBLED and self._previous is not None:
            taken = self._previous
        self._previous = taken
        return taken.astype(np.float32)


def named(scene: Scene, seed: int, kinds: tuple[FaultKind, ...]) -> tuple[dict[str, FaultKind], dict[str, FaultKind]]:
    """Return the faults that were made, at random frames, and those that the judge names at the end; where none was made, also those that
    it names at once."""
    rig = rig_of(scene)
    shots, random, judge = shots_on(rig), np.random.default_rng(seed), Judge(rig)
    light = scene.radiance.mean(axis=(1, 2, 3))
    bright = light > VISIBLE * light.mean()
    able = [index for index, shot in enumerate(shots)
            if shot.lamp is not None and bright[shot.lamp] and bright[(shot.lamp + 1) % len(light)]]
    made: dict[int, FaultKind] = {}
    for kind in kinds:  # beside a wrong lamp stands a right picture of the lamp that shone
        free = [index for index in able if not {index - 1, index, index + 1} & made.keys()
                and (kind is not FaultKind.AMBIENT or light[shots[index].lamp] < BRIGHT * light.mean())]
        made[int(random.choice(free))] = kind
    camera = NoisyCamera(scene, seed)
    at_once: list[Fault] = []
    for index, shot in enumerate(shots):
        pixels = camera.take(shot, made.get(index))
        faults = judge.judge(shot, pixels, "lin_rec709_scene", FULL_SCALE)
        judge.accept(shot, pixels, "lin_rec709_scene", FULL_SCALE, faults)
        at_once += faults
    found = [*judge.review(), *(at_once if not made else ())]
    return {shots[index].key: kind for index, kind in made.items()}, {fault.shot: fault.kind for fault in found}


@contextmanager
def owl_on_stage(folder: Path, *options: object) -> Iterator[list[object]]:
    """Run the twin, with options for it, as long as the block; yield the options of `relit capture` that name lamps, camera and --trigger.

    Its lamps are a third as bright as those of the owl's capture.
    """
    rig, watched, host = folder / "rig.json", folder / "watched", loopback()
    write_rig(rig, [frame.light.direction for frame in Capture.open(OWL).manifest.frames], {"white": (1.0, 1.0, 1.0)}, host=host)
    with twin_running(rig, OWL, host, "--pictures", watched, "--noise", "0.001", "--exposure", "-2", "--cache", folder,
                      *options) as (_, page):
        yield ["--rig", rig, "--camera", f"watch:{watched}", "--trigger", posting(f"{page}/release")]
