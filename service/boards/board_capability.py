"""Capability of a process over several boards: how the values of each pad or region lie in their limits → capability.csv and report.json.

Source: AIAG, Statistical Process Control, 2nd edition, 2005: indices from the scatter of all boards together (Pp and Ppk there, Cp and Cpk
in common speech); the lower bound of Cpk by Bissell, "How reliable is your capability index?", Applied Statistics 39(3), 1990.
"""

import json
from pathlib import Path
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np

from service.boards.findings import rounded
from service.boards.study_checks import check_runs
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, report
from service.requests.inspect_board import BoardCapabilityRequest
from stage import inputs
from stage.errors import BoardError, ManifestError
from stage.files import write_text
from stage.formats.csv_table import table_text
from stage.records import read_record
from stage.sets.board import GaugeRuns
from stage.stack.fingerprint import digest

CAPABILITY_FILE = "capability.csv"
METHOD = "process capability"
LEAST_BOARDS = 3
CONFIDENCE = NormalDist().inv_cdf(0.95)
"""σ of the one-sided bound that Cpk exceeds with a probability of 95 %."""
Limits = tuple[float, float]
Value = tuple[str, str]
"""Name of a pad or region, and of what was measured of it."""


class Capability(NamedTuple):
    """How the values of one quantity of one pad or region lie in its limits."""

    name: str
    quantity: str
    low: float
    high: float
    boards: int
    mean: float
    sigma: float
    """Standard deviation from board to board."""
    cp: float
    """Width of the limits over six σ."""
    cpk: float
    """Distance of the mean to the nearer limit over three σ; negative beyond it."""
    cpk_bound: float
    """What Cpk exceeds with a probability of 95 %."""


class BoardCapabilityResult(NamedTuple):
    """The files and indices of a study that was written."""

    table_path: Path
    report_path: Path
    found: list[Capability]
    """The least capable first."""
    left_out: tuple[str, ...]
    """What fewer than LEAST_BOARDS boards have, or what does not vary."""
    warnings: tuple[str, ...]
    """A sentence for each thing that the runs contradict."""


def board_capability(request: BoardCapabilityRequest, progress: Progress | None = None) -> BoardCapabilityResult:
    """Find the capability of every pad or region that has limits; several runs of a board count as their mean."""
    timings = Timings(progress)
    runs = read_record(request.study, GaugeRuns)
    timings.stage("read", len(runs.runs))
    values: dict[Value, dict[str, list[float]]] = {}
    limits: dict[Value, Limits] = {}
    each_run, inputs_of = [], []
    for number, run in enumerate(runs.runs, start=1):
        path = request.study.parent / run.result / REPORT_FILE
        measured, given = _values(path)
        each_run.append({key: value for key, (value, _) in measured.items()})
        inputs_of.append(given)
        for key, (value, own) in measured.items():
            if limits.setdefault(key, own) != own:
                raise BoardError(f"{path}: {' '.join(key)} has the limits {list(own)}, and {list(limits[key])} in another run: inspect all "
                                 "boards with the same limits")
            boards = values.setdefault(key, {})
            if value is not None:
                boards.setdefault(run.board, []).append(value)
        timings.advance(number)
    warnings = check_runs(request.study, runs.runs, each_run, inputs_of)
    found, left_out = [], []
    for key, boards in values.items():
        means = np.array([np.mean(each) for each in boards.values()])
        if len(means) < LEAST_BOARDS or np.ptp(means) == 0:
            left_out.append(" ".join(key))
        else:
            found.append(capability(key, means, limits[key]))
    if not found:
        raise BoardError(f"{request.study}: no pad or region with limits was measured on {LEAST_BOARDS} boards that differ")
    found.sort(key=lambda each: each.cpk)
    table_path, report_path = request.out / CAPABILITY_FILE, request.out / REPORT_FILE
    rows = [rounded(each._asdict()) for each in found]
    write_text(table_path, table_text(Capability._fields, (row.values() for row in rows)))
    write_text(report_path, report(
        request, inputs={"study": str(request.study), "name": runs.name, "content": digest(request.study)}, method=METHOD,
        boards=len({run.board for run in runs.runs}), left_out=left_out, capability=rows, warnings=warnings,
        timings_s=timings.close()))
    return BoardCapabilityResult(table_path, report_path, found, tuple(left_out), tuple(warnings))


def capability(key: Value, values: np.ndarray, limits: Limits) -> Capability:
    """Return the indices of values, one for each board, [n]."""
    count, mean, sigma, (low, high) = len(values), float(values.mean()), float(values.std(ddof=1)), limits
    cpk = min(high - mean, mean - low) / (3 * sigma)
    bound = cpk - CONFIDENCE * float(np.sqrt(1 / (9 * count) + cpk**2 / (2 * (count - 1))))
    return Capability(*key, low, high, count, mean, sigma, (high - low) / (6 * sigma), cpk, bound)


def _values(path: Path) -> tuple[dict[Value, tuple[float | None, Limits]], dict[str, Any]]:
    """Return what an inspection measured that has limits, with the limits, and what its report was made of."""
    try:
        content = json.loads(inputs.read_bytes(path))
        given = content.get("inputs", {})
        if "pads" in content:
            return {(pad["name"], name): (pad[name], (low, high)) for pad in content["pads"]
                    for name, (low, high) in pad["limits"].items()}, given
        return {(region["name"], "deviation_m"): (region["deviation_m"], (region["tolerance_m"][0], region["tolerance_m"][1]))
                for region in content["regions"]}, given
    except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        raise ManifestError(f"{path}: is no report of relit inspect-paste, or of relit inspect-board with regions") from error
