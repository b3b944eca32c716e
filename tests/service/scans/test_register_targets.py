"""relit register with named targets in scan-set.json: a vase is placed, and a target that moved is told by its name."""

import json
from functools import cache

import numpy as np
import pytest

from stage.scans.rigid import applied, inverse
from tests.scenes.turntable import MM, View, turntable, vase
from tests.service.scans.test_register import off, write

PLACES = {f"T{k}": np.array(place) for k, place in enumerate(
    [(0.4, -0.4, 0), (0.2, 0.3, 0.4), (-0.2, -0.4, 0.4), (-0.4, 0.2, -0.1), (0, 0.4, -0.4)])}


@cache
def views() -> tuple[View, ...]:
    return tuple(turntable(vase, [0, 60, 130], rows=80))


def targets(**changed: np.ndarray) -> dict:
    """The targets of each scan; `changed` are other places in the last."""
    out = {}
    for number, view in enumerate(views()):
        rng = np.random.default_rng(number)
        places = {**PLACES, **(changed if number == 2 else {})}
        out[f"s{number}"] = {"targets": [
            {"name": name, "sigma_m": 1e-4,
             "position_m": (applied(inverse(view.world_from_scan), place[None])[0] + 1e-4 * rng.standard_normal(3)).tolist()}
            for name, place in places.items()]}
    return out


def test_a_vase_is_placed_by_targets_and_one_that_moved_is_named(relit, tmp_path):
    folder = write(tmp_path / "set", views(), **targets(T1=PLACES["T1"] + [0, 0.003, 0]))
    outcome = relit("register", folder, "--out", tmp_path / "out")
    assert outcome.code == 0, outcome.err
    assert max(shift for shift, _ in off(tmp_path / "out", views()).values()) < 0.5 * MM  # five σ of targets of .1 mm half a metre away
    assert "target T1: in s2 it lies 3" in outcome.err + outcome.out
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert {pair["by"] for pair in report["pairs"] if pair["state"] == "joined"} == {"targets"}
    place, = (place for place in report["targets"] if place["name"] == "T1")
    assert place["scans"] == ["s0", "s1"] and place["elsewhere"]["s2"] == pytest.approx(0.003, abs=5e-4)
    written = json.loads((tmp_path / "out" / "scan-set.json").read_text())
    assert [target["name"] for target in written["scans"][1]["targets"]] == list(PLACES)


@pytest.mark.parametrize(("target", "words"), [
    ({"name": "T0", "position_m": [0, 0, 1]}, "scans[0].targets[0].sigma_m"),
    ({"name": "T0", "position_m": [0, 0], "sigma_m": 1e-4}, "scans[0].targets[0].position_m"),
    ({"name": "T0", "position_m": [0, 0, 1], "sigma_m": 0}, "scans[0].targets[0].sigma_m"),
])
def test_bad_targets_are_refused_by_their_field(relit, tmp_path, target, words):
    outcome = relit("register", write(tmp_path / "set", views(), s0={"targets": [target]}), "--out", tmp_path / "out")
    assert outcome.code == 2 and words in outcome.err and not (tmp_path / "out").exists()


def test_a_target_is_listed_once(relit, tmp_path):
    one = {"name": "T0", "position_m": [0, 0, 1], "sigma_m": 1e-4}
    outcome = relit("register", write(tmp_path / "set", views(), s0={"targets": [one, one]}), "--out", tmp_path / "out")
    assert outcome.code == 2 and "T0 is there twice" in outcome.err
