"""Metals that no pixel nearby shows become dielectrics; a metal with a wrong normal among others that shine stays one."""

import numpy as np

from kernels.photometric.material.lost_light import account_light
from kernels.photometric.model.chosen_samples import choose
from kernels.photometric.search.hypotheses import LobeShape
from kernels.photometric.search.lobe_shape import UNKNOWN_SPREAD
from service.solve.base.solution import Solution
from service.solve.methods.kinds import Kind, Kinds
from service.solve.methods.unseen_metals import replace_unseen_metals
from tests.kernels.photometric.material.test_blurred_metals import of_one_material
from tests.kernels.photometric.material.test_mixtures import GOLD, metal
from tests.kernels.photometric.test_svbrdf import render, sample
from tests.scenes.glossy import sphere_directions

SIDE, ROUGHNESS, F0, ALBEDO = 12, 0.3, 0.04, np.array([0.12, 0.08, 0.05])
SHARED = np.array([[F0, F0, F0, 0.5], [*GOLD, ROUGHNESS]], np.float32)
OPENING = 0.85
"""Least z of the light that falls to the ground of the hollow: a cone of 32°."""
LIGHTS = sphere_directions(128)
NORMAL = np.tile([0.0, 0.0, 1.0], (SIDE * SIDE, 1))
TILTED = np.array([np.sin(np.radians(50)), 0, np.cos(np.radians(50))])


def test_a_hollow_is_no_metal_though_its_shadows_hide_the_highlights_of_one(device):
    columns = np.arange(SIDE * SIDE) % SIDE
    hollow = columns < 5
    reached = (LIGHTS[:, 2] > OPENING)[None, :, None]
    paint = render(NORMAL, albedo=ALBEDO, alpha=0.5**2, f0=F0, lights=LIGHTS)
    radiance = np.where(hollow, reached * paint, metal(NORMAL, ROUGHNESS**2, LIGHTS))
    samples, _ = sample(radiance, device, lights=LIGHTS)
    turned = hollow | (columns == 8)  # by 50 degrees, to where no light of the cone shows a highlight; one column of the gold too
    normal = np.where(turned[:, None], TILTED, NORMAL).astype(np.float32)
    count = len(normal)
    solution = Solution.empty(count)
    solution.normal = normal.T.copy()
    solution.specular, solution.roughness = np.tile(np.float16(GOLD)[:, None], count), np.full(count, ROUGHNESS, np.float16)
    solution.albedo_own, solution.albedo_tilt = np.zeros_like(solution.albedo), np.zeros_like(solution.albedo)
    shown = account_light(samples, normal, of_one_material([0] * 3, GOLD, ROUGHNESS, count=count)).shown
    assert shown[hollow].max() < 0.2 and shown[columns == 8].max() < 0.35  # gold shines where its true normal says
    assert shown[~turned].min() > 0.99  # half floats of the stack
    kinds = Kinds(Kind(LobeShape(), LobeShape(), UNKNOWN_SPREAD, SHARED), count)
    changed = replace_unseen_metals(solution, shown, (SIDE, SIDE), kinds, lambda pixels: choose(samples, pixels))
    assert set(changed) <= set(np.flatnonzero(hollow)) and len(changed) >= 4 * SIDE  # the column beside the gold may stay
    assert (solution.specular[:, changed] == np.float16(F0)).all() and solution.facts["unseen_metals"] == len(changed)
    assert (solution.albedo[:, changed] > 0).all() and (solution.albedo_own[:, changed] > 0).all()
    kept = np.setdiff1d(np.arange(count), changed)
    assert (solution.specular[:, kept] == np.float16(GOLD)[:, None]).all()
