"""relit gauge-board: variances that were put into the reports of inspections come back, and what is missing is one sentence."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from service.boards.gauge_board import gauge_study

REGIONS, BOARDS, OPERATORS, TRIALS = 6, 5, 3, 4


def write_study(folder: Path, *, seed: int = 0) -> Path:
    """Reports with 0.5 µm repeatability, 0.3 µm between operators and 4 µm between parts."""
    rng = np.random.default_rng(seed)
    truth, bias = 4e-6 * rng.standard_normal((BOARDS, REGIONS)), 3e-7 * np.array([-1.0, 0.0, 1.0])
    runs = []
    for board in range(BOARDS):
        for operator in range(OPERATORS):
            for trial in range(TRIALS):
                name = f"run_{board}_{operator}_{trial}"
                regions = [{"name": f"pad {k}", "verdict": "pass", "tolerance_m": [-2e-5, 3e-5], "sigma_m": 5e-7,
                            "deviation_m": truth[board, k] + bias[operator] + 5e-7 * rng.standard_normal()} for k in range(REGIONS)]
                (folder / name).mkdir(parents=True)
                (folder / name / "report.json").write_text(json.dumps({"schema": "relit.report/1", "regions": regions}))
                runs.append({"result": name, "board": f"board {board}", "operator": f"station {operator}"})
    (folder / "study.json").write_text(json.dumps({"schema": "relit.gauge-study/1", "name": "pads", "runs": runs}))
    return folder / "study.json"


def change(study: Path, edit) -> None:
    data = json.loads(study.read_text())
    edit(data)
    study.write_text(json.dumps(data))


def test_the_variances_come_back(relit, tmp_path):
    """270 degrees of freedom give the repeatability to 4 %; three operators give their σ of 0.3 µm to a factor, 30 parts theirs to 13 %."""
    relit.done("gauge-board", write_study(tmp_path), "--out", tmp_path / "out")
    study = json.loads((tmp_path / "out" / "report.json").read_text())["study"]
    assert (study["parts"], study["operators"], study["trials"]) == (30, 3, 4)
    assert study["repeatability_m"] == pytest.approx(5e-7, rel=0.13)  # 3 σ
    assert study["reproducibility_m"] == pytest.approx(3e-7, rel=0.4)
    assert study["part_m"] == pytest.approx(4e-6, rel=0.4)
    assert study["gauge_m"] ** 2 == pytest.approx(study["repeatability_m"] ** 2 + study["reproducibility_m"] ** 2, rel=1e-4)
    assert study["tolerance_percent"] == pytest.approx(100 * 6 * study["gauge_m"] / 5e-5, rel=1e-3)
    with open(tmp_path / "out" / "gauge.csv", newline="") as table:
        rows = list(csv.DictReader(table))
    assert len(rows) == 30 and len(rows[0]["values"].split()) == OPERATORS * TRIALS


def test_regions_that_a_run_did_not_measure_are_named(relit, tmp_path):
    study = write_study(tmp_path)
    path = tmp_path / "run_2_1_0" / "report.json"
    report = json.loads(path.read_text())
    report["regions"][3]["deviation_m"] = None
    path.write_text(json.dumps(report))
    assert "out 1 regions that not every run measured: board 2 pad 3" in relit.done("gauge-board", study, "--out", tmp_path / "out").out


@pytest.mark.parametrize(("edit", "words"), [
    (lambda data: data["runs"].pop(), "station 2 measured board 4 3 times, others measured boards 4"),
    (lambda data: data["runs"][1].update(result="run_0_0_0"), "runs: the result run_0_0_0 is given twice"),
    (lambda data: data["runs"][0].update(result="../x"), "../x leads out of the folder of the file"),
    (lambda data: data["runs"][0].update(result="nothing"), "nothing/report.json"),
    (lambda data: data.update(runs=[run for run in data["runs"] if run["result"].endswith("_0")]), "30 parts and 1 trials"),
])
def test_what_is_no_study_is_one_sentence(relit, tmp_path, edit, words):
    study = write_study(tmp_path)
    change(study, edit)
    assert words in relit.refused("gauge-board", study, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_report_without_regions_is_named(relit, tmp_path):
    study = write_study(tmp_path)
    (tmp_path / "run_0_0_0" / "report.json").write_text("{}")
    assert "run_0_0_0/report.json: is no report of relit inspect-board" in relit.refused("gauge-board", study, "--out", tmp_path / "out")


AIAG = np.array([
    [[0.29, -0.56, 1.34, 0.47, -0.80, 0.02, 0.59, -0.31, 2.26, -1.36], [0.41, -0.68, 1.17, 0.50, -0.92, -0.11, 0.75, -0.20, 1.99, -1.25],
     [0.64, -0.58, 1.27, 0.64, -0.84, -0.21, 0.66, -0.17, 2.01, -1.31]],
    [[0.08, -0.47, 1.19, 0.01, -0.56, -0.20, 0.47, -0.63, 1.80, -1.68], [0.25, -1.22, 0.94, 1.03, -1.20, 0.22, 0.55, 0.08, 2.12, -1.62],
     [0.07, -0.68, 1.34, 0.20, -1.28, 0.06, 0.83, -0.34, 2.19, -1.50]],
    [[0.04, -1.38, 0.88, 0.14, -1.46, -0.29, 0.02, -0.46, 1.77, -1.49], [-0.11, -1.13, 1.09, 0.20, -1.07, -0.67, 0.01, -0.56, 1.45, -1.77],
     [-0.15, -0.96, 0.67, 0.11, -1.45, -0.49, 0.21, -0.49, 1.87, -2.16]],
]).transpose(2, 0, 1)
"""The study of AIAG, Measurement Systems Analysis, 4th edition, figure III-B 15: [parts, operators, trials]."""


def test_the_example_of_the_book():
    """Table III-B 7 of the book: EV 0.199933, AV 0.226838, GRR 0.302373, PV 1.042327, 27.86 %, four categories."""
    study = gauge_study(AIAG)
    assert study.interaction is None  # F is 0.434, so that it is pooled
    found = study.repeatability, study.reproducibility, study.gauge, study.part
    assert found == pytest.approx((0.199933, 0.226838, 0.302373, 1.042327), abs=1e-5)
    assert study.gauge_percent == pytest.approx(27.86, abs=0.01)
    assert study.categories == 4
    assert study.tolerance_percent(8.0) == pytest.approx(100 * 6 * 0.302373 / 8, rel=1e-5)


def test_known_variances_come_back():
    """40 parts, 12 operators, 6 trials: standard deviations to 3 %, of operators and their interaction to 25 %."""
    rng = np.random.default_rng(3)
    shape = (40, 12, 6)
    values = (3.0 * rng.standard_normal(shape[0])[:, None, None] + 0.8 * rng.standard_normal(shape[1])[None, :, None]
              + 0.5 * rng.standard_normal(shape[:2])[..., None] + 0.4 * rng.standard_normal(shape))
    study = gauge_study(values)
    assert study.repeatability == pytest.approx(0.4, rel=0.05)
    assert study.interaction == pytest.approx(0.5, rel=0.1)
    assert study.reproducibility == pytest.approx(np.hypot(0.8, 0.5), rel=0.35)
    assert study.part == pytest.approx(3.0, rel=0.25)


def test_one_operator_tells_the_repeatability_alone():
    study = gauge_study(AIAG[:, :1])
    assert study.reproducibility is None and study.interaction is None
    assert study.repeatability == pytest.approx(np.sqrt(AIAG[:, 0].var(axis=1, ddof=1).mean()))
    assert study.gauge == study.repeatability and study.gauge_bound == pytest.approx(study.repeatability_bound)


def test_too_little_is_refused():
    with pytest.raises(ValueError, match="there are 1 parts and 3 trials: two or more of each are"):
        gauge_study(AIAG[:1])


def test_a_measurement_that_is_counted_twice_is_refused(relit, tmp_path):
    """A copy of a run repeats to all digits, which no gauge does."""
    study = write_study(tmp_path)
    (tmp_path / "run_0_0_1" / "report.json").write_bytes((tmp_path / "run_0_0_0" / "report.json").read_bytes())
    said = relit.refused("gauge-board", study, "--out", tmp_path / "out")
    assert "run_0_0_1 has the same values as run_0_0_0" in said and not (tmp_path / "out").exists()


def test_boards_that_are_exchanged_are_named_and_repeat_worse_than_stated(relit, tmp_path):
    study = write_study(tmp_path)
    right = relit("gauge-board", study, "--out", tmp_path / "right")
    assert right.code == 0 and "is named" not in right.out and "times the σ that they state" not in right.out
    report = json.loads((tmp_path / "right" / "report.json").read_text())
    doubt, = report["warnings"]  # three operators tell their spread badly
    assert "is not known from 3 operators" in doubt and report["study"]["repeatability_bound_m"] == pytest.approx(
        report["study"]["repeatability_m"] * np.sqrt(270 / 233.0), rel=0.01)  # χ² of 270 degrees of freedom has its 5 % point at 233
    change(study, lambda data: [run.update(board=other) for run, other in ((data["runs"][0], "board 3"), (data["runs"][36], "board 0"))])
    assert relit("gauge-board", study, "--out", tmp_path / "wrong").code == 0
    said = json.loads((tmp_path / "wrong" / "report.json").read_text())["warnings"]
    assert "run_0_0_0 is named board 3" in said[0] and "run_3_0_0 is named board 0" in said[1] and len(said) == 4
    assert "measures as board 0" in said[0] and "measures as board 3" in said[1] and "times the σ" in said[2]


def test_runs_against_different_golden_boards_are_said(relit, tmp_path):
    study = write_study(tmp_path)
    for name, golden in (("run_0_0_0", "a"), ("run_1_0_0", "b")):
        path = tmp_path / name / "report.json"
        path.write_text(json.dumps({**json.loads(path.read_text()), "inputs": {"golden": golden}}))
    outcome = relit("gauge-board", study, "--out", tmp_path / "out")
    assert outcome.code == 0 and "another one of the golden boards" in outcome.out + outcome.err


@pytest.mark.long
@pytest.mark.parametrize("shape", [(10, 2, 2), (10, 3, 3), (20, 6, 2)], ids=str)
@pytest.mark.parametrize("operators", [0.5, 2.0, 5.0])
def test_the_gauge_is_below_its_bounds_with_95_percent(shape, operators):
    """800 studies: 0.95 ± 0.023 (3 σ); more where operators do not differ, since a difference that is not there may still be missed."""
    rng = np.random.default_rng(2)
    truth, below = np.hypot(operators, 1.0), []
    for _ in range(800):
        study = gauge_study(5 * rng.standard_normal(shape[0])[:, None, None] + operators * rng.standard_normal(shape[1])[None, :, None]
                            + rng.standard_normal(shape))
        assert study.gauge <= study.gauge_bound and study.gauge_percent <= study.gauge_percent_bound
        below.append((truth <= study.gauge_bound, 100 * truth / np.hypot(truth, 5) <= study.gauge_percent_bound))
    share = np.mean(below, axis=0)
    assert (share > 0.927).all() and (operators < 5 or (share < 0.973).all())


def test_a_bound_beyond_a_limit_that_the_gauge_is_below_is_said(relit, tmp_path):
    """Two of three stations are left: their difference is known from one number."""
    study = write_study(tmp_path)
    change(study, lambda data: data.update(runs=[run for run in data["runs"] if run["operator"] != "station 0"]))
    outcome = relit.done("gauge-board", study, "--out", tmp_path / "out")
    found = json.loads((tmp_path / "out" / "report.json").read_text())
    assert found["study"]["tolerance_percent"] < 10 < found["study"]["tolerance_percent_bound"]
    assert any("is not known from 2 operators and 30 parts" in sentence for sentence in found["warnings"])
    assert found["study"]["gauge_bound_m"] > found["study"]["gauge_m"]
    assert "sure     95 %: gauge below" in outcome.out
