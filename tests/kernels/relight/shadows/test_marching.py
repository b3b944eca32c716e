"""Groups of samples that share one march."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from kernels.relight.model import sources
from kernels.relight.model.sources import disc_samples, grouped
from tests.kernels.relight.lights import scattered

FIRST = 40
ROUND = 1e-6
"""Distances of float32 places."""


def shadowed(count, seed=0):
    """Far samples of unequal energy, each hidden by three rows."""
    rng = np.random.default_rng(seed)
    given = sources.far(scattered(count, seed), rng.gamma(0.3, 1.0, (count, 3)))
    return given._replace(occluder=rng.integers(0, FIRST, (count, 3)).astype(np.int32),
                          share=rng.dirichlet(np.ones(3), count).astype(np.float32))


def check(given, wanted, got, places, *, most, reach):
    """What holds whatever the samples; returns which of them were grouped."""
    for field in ("place", "energy", "axis"):
        np.testing.assert_array_equal(getattr(got, field), getattr(given, field))
    assert places.shape[1] == 4 and len(places) <= min(most, wanted.sum())
    moved = (got.occluder[:, 0] >= FIRST)
    assert not moved[~wanted].any()
    np.testing.assert_array_equal(got.occluder[~moved], given.occluder[~moved])
    np.testing.assert_array_equal(got.share[~moved], given.share[~moved])
    assert (got.occluder[moved, 1:] == sources.NEVER).all() and (got.share[moved] == [1, 0, 0]).all()
    group = got.occluder[moved, 0] - FIRST
    assert group.size == 0 or group.max() < len(places)
    away = np.linalg.norm(given.place[:, None, :3].astype(float) - places[None, :, :3], axis=2)
    assert (away[moved, group] <= reach + ROUND).all()
    np.testing.assert_allclose(away[moved, group], away[moved].min(axis=1, initial=np.inf), atol=ROUND)  # to the nearest of the middles
    if len(places):
        assert (away[wanted & ~moved].min(axis=1, initial=np.inf) > reach - ROUND).all()
    for place in places:
        assert (given.place[wanted] == place).all(axis=1).any()  # middles are samples
    return moved


@pytest.mark.long
@settings(max_examples=30, deadline=None)
@given(count=st.integers(1, 200), seed=st.integers(0, 99), most=st.integers(1, 30), reach=st.floats(0.01, 3.0), part=st.floats(0, 1))
def test_groups(count, seed, most, reach, part):
    given, wanted = shadowed(count, seed), np.random.default_rng(seed).random(count) < part
    check(given, wanted, *grouped(given, wanted, FIRST, most=most, reach=reach), most=most, reach=reach)


def test_a_middle_for_each_sample_if_there_may_be_so_many():
    given = shadowed(20)
    got, places = grouped(given, np.ones(20, dtype=bool), FIRST, most=50, reach=1e-9)
    assert len(places) == 20
    np.testing.assert_array_equal(places[got.occluder[:, 0] - FIRST], given.place)


def test_rows_begin_with_the_first():
    got, places = grouped(shadowed(60), np.ones(60, dtype=bool), FIRST, most=8, reach=np.inf)
    assert len(places) == 8 and set(got.occluder[:, 0].tolist()) == set(range(FIRST, FIRST + 8))


def test_middles_are_bright_first_and_then_far():
    """By hand: four on a line at 0, 1, 2 and 10 with energies 9, 1, 2 and 1: first the one at 0, then the one at 10 for its 1 · 10²,
    then of those between, 1 · 1² and 2 · 2², the one at 2."""
    place = np.float32([[0, 0, 5, 1], [1, 0, 5, 1], [2, 0, 5, 1], [10, 0, 5, 1]])
    given = sources.join([sources.point(p[:3], np.full(3, e)) for p, e in zip(place, (9, 1, 2, 1), strict=True)])
    for most, chosen in ((1, [0]), (2, [0, 3]), (3, [0, 3, 2])):
        got, places = grouped(given, np.ones(4, dtype=bool), FIRST, most=most, reach=1e30)
        np.testing.assert_array_equal(places, place[chosen])
    np.testing.assert_array_equal(got.occluder[:, 0] - FIRST, [0, 0, 2, 1])


def test_unwanted_samples_have_no_say():
    given, wanted = shadowed(30), np.arange(30) % 2 == 0
    got, places = grouped(given, wanted, FIRST, most=5, reach=0.8)
    alone, same = grouped(given._replace(**{name: getattr(given, name)[wanted] for name in given._fields}), np.ones(15, dtype=bool), FIRST,
                          most=5, reach=0.8)
    np.testing.assert_array_equal(places, same)
    np.testing.assert_array_equal(got.occluder[wanted], alone.occluder)
    np.testing.assert_array_equal(got.share[wanted], alone.share)


def test_a_sun_is_a_few_marches_from_within_it():
    """Of a disc of 3 degrees, 24 groups: its samples are not a degree from theirs."""
    directions = disc_samples(np.array([0.48, 0.6, 0.64]), 3.0)
    given = sources.far(directions, np.ones((len(directions), 3)))
    got, places = grouped(given, np.ones(len(directions), dtype=bool), FIRST, most=24, reach=np.radians(1))
    assert len(places) == 24 and (got.occluder[:, 0] >= FIRST).all()
    assert np.bincount(got.occluder[:, 0] - FIRST).max() < 3 * len(directions) / 24  # evenly, about


def test_samples_in_one_place_and_dark_ones_are_one_group():
    alike = sources.far(np.tile([[0.6, 0, 0.8]], (7, 1)), np.ones((7, 3)))
    for samples, most, reach in ((alike, 5, 0.0), (shadowed(9)._replace(energy=np.zeros((9, 3), np.float32)), 4, 1e30)):
        got, places = grouped(samples, np.ones(len(samples.energy), dtype=bool), FIRST, most=most, reach=reach)
        assert len(places) == 1 and (got.occluder[:, 0] == FIRST).all()


def test_energy_below_none_weighs_as_much():
    given = shadowed(50)
    got, places = grouped(given._replace(energy=-given.energy), np.ones(50, dtype=bool), FIRST, most=6, reach=0.5)
    expected, same = grouped(given, np.ones(50, dtype=bool), FIRST, most=6, reach=0.5)
    np.testing.assert_array_equal(places, same)
    np.testing.assert_array_equal(got.occluder, expected.occluder)


@pytest.mark.parametrize("count", [0, 12])
def test_nothing_wanted_is_nothing_changed(count):
    given = shadowed(12) if count else sources.far(np.zeros((0, 3)), np.zeros((0, 3)))
    got, places = grouped(given, np.zeros(count, dtype=bool), FIRST, most=4, reach=1.0)
    assert places.shape == (0, 4)
    for before, after in zip(given, got, strict=True):
        np.testing.assert_array_equal(before, after)
