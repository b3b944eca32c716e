"""Checks of the runs of a study of boards: a measurement that is counted twice, boards that are named wrongly, runs that were compared with
different golden boards or designs."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stage.errors import BoardError
from stage.sets.board import GaugeRun
from stage.spread import MAD_TO_SIGMA

LEAST_VALUES = 3
"""The fewest values by which a run is taken for that of another board."""
LEAST_RUNS = 3
"""The fewest runs of a board that say how it measures."""
LEAST_LOG_ODDS = 14.0
"""Log odds (a million to one, normal scatter given) by which a run must be rather another board's, for all runs and boards together."""
FEW = 4.0
"""The scatter of n runs is widened by this over n, a part of it: that of few is known badly."""

Values = Mapping[Any, float | None]


def check_runs(study: Path, runs: Sequence[GaugeRun], values: Sequence[Values], inputs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a sentence for each thing that runs contradict.

    Args:
        values: of each run, what was measured, by region or pad; None where it was not.
        inputs: of each run, the entry `inputs` of its report.

    Raises:
        BoardError: two runs are one measurement.
    """
    seen: dict[tuple[Any, ...], GaugeRun] = {}
    for run, each in zip(runs, values, strict=True):
        measured = tuple(sorted((str(key), value) for key, value in each.items() if value is not None))
        if len({value for _, value in measured}) < 2:
            continue
        if measured in seen:
            raise BoardError(f"{study}: runs: {run.result} has the same values as {seen[measured].result} in all digits: it is the same "
                             "measurement, which would make the study surer than it is")
        seen[measured] = run
    return [*_misnamed(runs, values), *_compared(runs, inputs)]


def _misnamed(runs: Sequence[GaugeRun], values: Sequence[Values]) -> list[str]:
    keys = [key for key in dict.fromkeys(key for each in values for key in each) if all(each.get(key) is not None for each in values)]
    boards = list(dict.fromkeys(run.board for run in runs))
    named = np.array([boards.index(run.board) for run in runs])
    if len(keys) < LEAST_VALUES or len(boards) < 2 or np.bincount(named).min() < LEAST_RUNS:
        return []
    table = np.array([[each[key] for key in keys] for each in values], dtype=np.float64)
    others = [(named == board) & (np.arange(len(runs)) != number) for number, board in enumerate(named)]
    own = np.array([row - np.median(table[same], axis=0) for row, same in zip(table, others, strict=True)])
    scatter = (1 + FEW / len(runs)) * np.maximum(MAD_TO_SIGMA * np.median(np.abs(own), axis=0), 1e-30)
    middles = np.array([np.median(table[named == board], axis=0) for board in range(len(boards))])
    least = LEAST_LOG_ODDS + np.log(len(runs) * len(boards))
    said = []
    for run, board, row, away in zip(runs, named, table, own, strict=True):
        cost = np.square((row - middles) / scatter).sum(axis=1) / 2
        cost[board] = np.inf
        if np.square(away / scatter).sum() / 2 - cost.min() > least:
            said.append(f"runs: {run.result} is named {run.board} and measures as {boards[cost.argmin()]} does: check which board it was")
    return said


def _compared(runs: Sequence[GaugeRun], inputs: Sequence[Mapping[str, Any]]) -> list[str]:
    said = []
    for name, what in (("golden", "golden boards"), ("design", "designs"), ("regions", "files of regions")):
        given = [each.get(name) for each in inputs]
        if len(set(given)) > 1:
            other = next(number for number, each in enumerate(given) if each != given[0])
            said.append(f"runs: {runs[other].result} was compared with another one of the {what} than {runs[0].result}: what those differ "
                        "by counts as variation")
    return said
