"""The judge of pictures against pictures in memory whose faults are known."""

import numpy as np
import pytest

from service.acquisition.checks.fault import FaultKind
from service.acquisition.checks.judge import FULL_SCALE, Judge
from stage.transforms import fibonacci_sphere
from tests.scenes.captures import make_scene
from tests.service.acquisition.scenes import NoisyCamera, Scene, owl, relief, rig_of, shots_on

KINDS = (FaultKind.UNLIT, FaultKind.WRONG_LIGHT, FaultKind.DOUBLED, FaultKind.MOVED, FaultKind.CLIPPED, FaultKind.AMBIENT,
         FaultKind.UNSHARP)
VISIBLE = 0.3
"""Faults are put where a lamp gives this part of the mean light of a lamp: behind the object nothing tells a lamp from none."""

BRIGHT = 1.5
"""Ambient light of 0.8 of the mean picture goes where a lamp gives less than this: the prediction errs by more beside the brightest."""


def named(scene: Scene, seed: int, kinds: tuple[FaultKind, ...]) -> tuple[dict[str, FaultKind], dict[str, FaultKind]]:
    """Return the faults that were made, at random frames, and those that the judge names at the end."""
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
    for index, shot in enumerate(shots):
        pixels = camera.take(shot, made.get(index))
        judge.accept(shot, pixels, "lin_rec709_scene", FULL_SCALE, judge.judge(shot, pixels, "lin_rec709_scene", FULL_SCALE))
    return {shots[index].key: kind for index, kind in made.items()}, {fault.shot: fault.kind for fault in judge.review()}


@pytest.mark.parametrize(("scene", "seed", "kinds"), [(1, 1, ()), (1, 1, KINDS), (108, 8, KINDS)])
def test_each_fault_is_named_with_its_frame_and_none_else(scene, seed, kinds):
    """The second scene has two lamps whose pictures differ by a fifth of what the third nearest differs by, beside pictures left out."""
    made, found = named(relief(scene), seed, kinds)
    assert found == made


@pytest.mark.long
@pytest.mark.parametrize("scene", [owl, lambda: relief(5)], ids=["owl", "relief"])
def test_each_fault_is_named_over_random_seeds(scene):
    pictures = scene()
    for seed in (*range(6), 17):  # of the last, lamps around the dead one light next to nothing
        made, found = named(pictures, seed, KINDS if seed else ())
        assert found == made, seed


def test_the_highlight_of_a_glossy_ball_has_not_moved():
    """A highlight moves with the lamp, and lies in part where each of the lamps around has its own, as a prediction says."""
    directions = fibonacci_sphere(160)
    directions = directions[directions[:, 2] > 0.3]
    across = (2 * np.arange(96) + 1) / 80 - 1.2
    x, y = np.meshgrid(across, -across)
    normal = np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], axis=-1)
    half = directions + [0.0, 0.0, 1.0]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    lit = np.maximum(np.einsum("lc,rkc->lrk", directions, normal), 0) * (normal[..., 2] > 0)
    gloss = 5 * np.maximum(np.einsum("lc,rkc->lrk", half, normal), 0) ** 120 * (lit > 0)
    scene = Scene(np.repeat((0.15 * (lit + gloss))[..., None], 3, axis=-1).astype(np.float32), directions)
    assert named(scene, 1, ()) == ({}, {})


def test_the_lamp_beside_the_camera_of_a_small_dome_is_no_ambient_light():
    """No lamp of seven is predicted, because the one beside the camera is brighter than the mean of those around it."""
    ring = make_scene(size=64, lights=7)
    scene = Scene(ring.images.astype(np.float32), ring.directions)
    made, found = named(scene, 1, ())
    assert made == found == {}


@pytest.mark.parametrize("dark", [2, 0])
@pytest.mark.parametrize("ambient", [0.0, 0.8])
def test_where_no_lamp_is_reached_all_pictures_are_named(dark, ambient):
    """In the dark, where pictures are noise, and in a room with its lights on, where all show the same."""
    scene = relief(1)
    rig, random, judge = rig_of(scene), np.random.default_rng(1), Judge(rig_of(scene))
    room = ambient * scene.radiance.mean(axis=0)
    shots = [shot for shot in shots_on(rig)[2 - dark:] if shot.lamp is not None or not shot.levels.any()]
    at_once = 0
    for shot in shots:
        pixels = np.clip(room + 0.001 * random.standard_normal(room.shape), 0, 1).astype(np.float32)
        faults = judge.judge(shot, pixels, "lin_rec709_scene", FULL_SCALE)
        at_once += bool(faults)
        judge.accept(shot, pixels, "lin_rec709_scene", FULL_SCALE, faults)
    lamps = [shot.key for shot in shots if shot.lamp is not None]
    assert {fault.shot: fault.kind for fault in judge.review()} == dict.fromkeys(lamps, FaultKind.UNLIT)
    assert at_once >= len(lamps) - 7  # of a room without a dark picture from the eighth on
