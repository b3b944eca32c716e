"""Fits to a target at known distances without each: how far they are known, and what the distances say of one another."""

import numpy as np
import pytest

from service.calibrate.solvers.tof_sweep import StepPhases, contradicting, fit_steps, fit_wiggling, target_faults, wiggling_sigma
from stage.tof.calibration import harmonic_terms
from tests.reference.tof import LIGHT

HZ = 80e6
METRE = 4 * np.pi * HZ / LIGHT


def wall(distances, turn=(0.0, 0.0), noise=0.0, seed=0):
    """Phases with wiggling on a wall at distances, of which each was missed by the noise."""
    x, y = np.meshgrid(np.linspace(-0.4, 0.4, 12), np.linspace(-0.3, 0.3, 9))
    rng, found = np.random.default_rng(seed), []
    for distance in distances:
        z = (distance + noise * rng.standard_normal()) / (1 - turn[0] * x - turn[1] * y)
        slant = np.sqrt(x**2 + y**2 + 1)
        true = METRE * z * slant
        phase = np.mod(true + 0.3 + 0.05 * np.cos(4 * true), 2 * np.pi)
        declared = distance * slant
        found.append(StepPhases(phase.ravel(), declared.ravel(), np.stack([x, y], axis=-1).reshape(-1, 2)))
    return found


def test_the_target_tells_how_it_is_turned_and_its_distances_how_they_are_scaled():
    """2.5° about the upright axis and -1.2° about the level one, and distances that are declared 0.4 % too long and missed by 2 mm."""
    distances, turn = np.linspace(0.8, 7.5, 25), np.array([0.044, -0.021])
    found = target_faults(wall(distances, turn), HZ)
    assert np.abs(found.turn - turn).max() < 1e-4 and found.scale is None
    placed = [step._replace(range_m=1.004 * step.range_m) for step in wall(distances, noise=0.002)]
    found = target_faults(placed, HZ)
    assert not found.turn.any() and found.scale == pytest.approx(1.004, abs=1e-3)
    assert target_faults(wall(distances, noise=0.005), HZ).scale is None


def errors_of(fit, steps):
    """By how much ranges of targets are off after a fit, metres."""
    off = [np.mean(np.angle(np.exp(1j * (step.phase - METRE * step.range_m - harmonic_terms(step.phase) @ fit.values)))) for step in steps]
    return np.array(off) / METRE


@pytest.mark.parametrize("seed", range(4))
def test_distances_tell_how_far_the_wiggling_is_known(seed):
    """The target is placed to 5 mm at 25 distances: what that makes of 25 harmonics, against what the distances say of it."""
    distances = np.linspace(0.8, 7.5, 25)
    placed, true = wall(distances, noise=0.005, seed=seed), wall(np.linspace(0.9, 7.4, 40))
    fit = fit_wiggling(placed, HZ)
    known = wiggling_sigma({HZ: placed})
    assert known.unseen is None and known.reached.all()
    ratio = np.sqrt(np.mean(errors_of(fit, true) ** 2)) / known.most_m
    assert 0.2 < ratio < 1.2  # some ten independent places: a third of it either way; the largest is 1.5 of the mean
    assert contradicting(fit.scatter / METRE) is None
    placed[12] = placed[12]._replace(range_m=placed[12].range_m + 0.06)
    assert contradicting(fit_wiggling(placed, HZ).scatter / METRE) == 12


@pytest.mark.parametrize("seed", range(4))
def test_phases_that_no_distance_shows_are_named_and_held(seed):
    """Targets placed to 2 mm show .8 to 2 m and from 2.6 m on, of a period of 1.87 m; wiggling between them is what the fit makes of it."""
    placed = wall([*np.linspace(0.8, 1.8, 14), 2.6], noise=0.002, seed=seed)
    known, off = wiggling_sigma({HZ: placed}), errors_of(fit_wiggling(placed, HZ), wall(np.linspace(2.0, 2.4, 20)))
    assert known.unseen is not None and 2.0 < known.range_m[known.unseen] < 2.6
    assert np.abs(off).max() > 0.01 and np.abs(off).max() < 4 * known.most_m  # up to four σ, because it is the largest of several places


def test_a_sweep_of_less_than_a_period_is_sure_where_it_was_and_names_the_rest():
    known = wiggling_sigma({HZ: wall(np.linspace(0.8, 1.9, 20), noise=0.002)})
    assert known.most_m < 0.01 and known.unseen is not None and not known.reached[known.unseen]


def test_steps_are_left_out_in_turn():
    """A line through readings against the fits that leave each out, made one by one."""
    rng = np.random.default_rng(0)
    matrices = [np.column_stack([rng.uniform(0, 1, 7), np.ones(7)]) for _ in range(5)]
    targets = [matrix @ (2.0, -1.0) + rng.normal(0, 0.1, 7) for matrix in matrices]
    fit = fit_steps(matrices, targets)
    for step in range(5):
        own = [other for other in range(5) if other != step]
        values = np.linalg.lstsq(np.concatenate([matrices[other] for other in own]), np.concatenate([targets[other] for other in own]))[0]
        assert fit.left_out[step] == pytest.approx(np.mean(targets[step] - matrices[step] @ values), rel=1e-9)
