"""Gauge studies of board inspections: the values that inspections measured at the same regions → gauge.csv and report.json.

Repeatability and reproducibility follow from the values by analysis of variance.

Sources:
    AIAG, Measurement Systems Analysis, 4th edition, 2010, chapter III, section B (ANOVA method).
    Burdick, Borror, Montgomery, "A review of methods for measurement systems capability analysis", Journal of Quality Technology 35(4),
    2003 (bounds of the gauge, by modified large samples).
"""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import fdtrc, fdtri
from scipy.stats import chi2

from service.boards.findings import six_digits
from service.boards.study_checks import check_runs
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, report
from service.requests.inspect_board import GaugeBoardRequest
from stage import inputs
from stage.errors import BoardError, ManifestError
from stage.files import write_text
from stage.formats.csv_table import table_text
from stage.records import read_record
from stage.sets.board import GaugeRuns
from stage.stack.fingerprint import digest

GAUGE_FILE = "gauge.csv"
METHOD = "gauge R&R (ANOVA)"
COLUMNS = ("board", "region", "mean_m", "repeatability_m", "sigma_m", "values")
POOL_PROBABILITY = 0.25
"""The interaction of parts and operators is pooled with the repeatability where chance alone makes it as large this often or more."""
SPREAD = 6.0
"""Standard deviations that a tolerance is compared with."""
NOISIER, CHANCE = 1.5, 0.001
"""The repeatability is said to be more than the inspections state where it is so many times that, and chance explains it this seldom."""
SURE = 0.95
"""Probability with which bounds hold."""
LIMITS_PERCENT = (30, 10)
"""Parts of a tolerance from which AIAG calls a gauge not acceptable, and up to which acceptable, per cent."""
CATEGORIES = 1.41
"""√2, as AIAG rounds it: the number of distinct categories is this times part over gauge variation."""


class GaugeStudy(NamedTuple):
    """Standard deviations of what makes measured values differ, in the unit of the values."""

    repeatability: float
    """Scatter of measurements of one part by one operator (equipment variation)."""
    reproducibility: float | None
    """Variation between operators, with the interaction of parts and operators (appraiser variation); None with one operator."""
    interaction: float | None
    """Variation of the operators' differences from part to part; None where it was pooled, or with one operator."""
    gauge: float
    """Repeatability and reproducibility together (GRR)."""
    part: float
    """Variation between parts."""
    total: float
    degrees_of_freedom: int
    """Degrees of freedom from which the repeatability is known."""
    gauge_bound: float
    """What the gauge is below with a probability of 95 %; with one operator, of its repeatability alone."""
    gauge_percent_bound: float
    """What %GRR is below with a probability of 95 %; with one operator, of the repeatability alone."""

    @property
    def repeatability_bound(self) -> float:
        """Return what the repeatability is below with a probability of 95 %, by the χ² distribution of its square."""
        return self.repeatability * math.sqrt(self.degrees_of_freedom / float(chi2.ppf(1 - SURE, self.degrees_of_freedom)))

    @property
    def gauge_percent(self) -> float:
        """Return gauge over total variation, per cent (%GRR)."""
        return 100 * self.gauge / self.total if self.total > 0 else 0.0

    @property
    def categories(self) -> int:
        """Return the number of distinct categories of parts that the gauge tells apart (ndc)."""
        return int(CATEGORIES * self.part / self.gauge) if self.gauge > 0 else 0

    def tolerance_percent(self, width: float) -> float:
        """Return six standard deviations of the gauge over the width of a tolerance, per cent."""
        return 100 * SPREAD * self.gauge / width

    def tolerance_percent_bound(self, width: float) -> float:
        """Return what `tolerance_percent` is below with a probability of 95 %."""
        return 100 * SPREAD * self.gauge_bound / width


class GaugeBoardResult(NamedTuple):
    """The files and numbers of a study that was written."""

    table_path: Path
    report_path: Path
    study: GaugeStudy
    tolerance_percent: float
    """Six standard deviations of the gauge over the narrowest tolerance of a region, per cent."""
    tolerance_percent_bound: float
    """What `tolerance_percent` is below with a probability of 95 %."""
    parts: int
    left_out: tuple[str, ...]
    """Regions of boards that not every run measured."""
    warnings: tuple[str, ...]
    """A sentence for each thing that the runs contradict."""
    noise_m: float
    """Root mean square of the σ that the inspections state: what the repeatability should be if only noise and placing matter."""


class _Part(NamedTuple):
    """One region of one board in all runs."""

    board: str
    region: str
    values: np.ndarray  # [operators, trials] metres
    sigmas: np.ndarray  # [operators, trials] metres
    width_m: float


def gauge_board(request: GaugeBoardRequest, progress: Progress | None = None) -> GaugeBoardResult:
    """Divide the variance of what several inspections measured into that of the gauge and that of the boards.

    A part of the study is a region of a board; its values are the deviations from the nominal height.
    """
    timings = Timings(progress)
    runs = read_record(request.study, GaugeRuns)
    timings.stage("read", len(runs.runs))
    found: dict[tuple[str, str], list[dict[str, Any]]] = {}
    values, inputs_of = [], []
    for number, run in enumerate(runs.runs, start=1):
        regions, given = _regions(request.study.parent / run.result / REPORT_FILE)
        found.setdefault((run.board, run.operator), []).append(regions)
        values.append({name: region.get("deviation_m") for name, region in regions.items()})
        inputs_of.append(given)
        timings.advance(number)
    warnings = check_runs(request.study, runs.runs, values, inputs_of)
    parts, left_out = _parts(request.study, found)
    try:
        study = gauge_study(np.array([part.values for part in parts]))
    except ValueError as error:
        raise BoardError(f"{request.study}: {error}") from error
    width = min(part.width_m for part in parts)
    noise = float(np.sqrt(np.mean([np.square(part.sigmas).mean() for part in parts])))
    percent = study.tolerance_percent(width)
    freedom = study.degrees_of_freedom
    if study.repeatability > NOISIER * noise > 0 and chi2.sf(freedom * (study.repeatability / noise) ** 2, freedom) < CHANCE:
        warnings.append(f"inspections of a board differ by {study.repeatability / noise:.2g} times the σ that they state: boards that are "
                        "named wrongly, that were moved or changed between runs, or a σ that is too small")
    bound = study.tolerance_percent_bound(width)
    crossed = next((limit for limit in LIMITS_PERCENT if percent < limit <= bound), None)
    if crossed is not None:
        operators = len({operator for _, operator in found})
        warnings.append(f"the gauge takes {percent:.3g} % of the narrowest tolerance, but may take up to {bound:.3g} % (95 % sure): that "
                        f"it takes less than {crossed} % is not known from {operators} operator{'s' * (operators > 1)} and {len(parts)} "
                        "parts: measure by more operators, or more boards")
    timings.stage("write", 1)
    table_path, report_path = request.out / GAUGE_FILE, request.out / REPORT_FILE
    write_text(table_path, _table(parts))
    write_text(report_path, report(
        request, inputs={"study": str(request.study), "name": runs.name, "content": digest(request.study)}, method=METHOD,
        study={"parts": len(parts), "operators": len({operator for _, operator in found}), "trials": parts[0].values.shape[1],
               **{f"{name}_m": None if value is None else six_digits(value) for name, value in study._asdict().items()
                  if name not in ("degrees_of_freedom", "gauge_percent_bound")},
               "repeatability_bound_m": six_digits(study.repeatability_bound), "degrees_of_freedom": study.degrees_of_freedom,
               "gauge_percent": float(f"{study.gauge_percent:.4g}"), "gauge_percent_bound": float(f"{study.gauge_percent_bound:.4g}"),
               "tolerance_percent": float(f"{percent:.4g}"), "tolerance_percent_bound": float(f"{bound:.4g}"),
               "narrowest_tolerance_m": width, "distinct_categories": study.categories,
               "stated_sigma_m": float(f"{noise:.4g}"), "left_out": left_out},
        warnings=warnings, timings_s=timings.close()))
    return GaugeBoardResult(table_path, report_path, study, percent, bound, len(parts), tuple(left_out), tuple(warnings), noise)


def _regions(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the regions of an inspection's report by name, and what it was made of."""
    try:
        content = json.loads(inputs.read_bytes(path))
        return {region["name"]: region for region in content["regions"]}, content.get("inputs", {})
    except (ValueError, KeyError, TypeError) as error:
        raise ManifestError(f"{path}: is no report of relit inspect-board with a design") from error


def _parts(path: Path, found: dict[tuple[str, str], list[dict[str, Any]]]) -> tuple[list[_Part], list[str]]:
    """Return the regions of boards that every run measured, and the names of the others."""
    boards = list(dict.fromkeys(board for board, _ in found))
    operators = list(dict.fromkeys(operator for _, operator in found))
    trials = len(next(iter(found.values())))
    for board in boards:
        for operator in operators:
            count = len(found.get((board, operator), []))
            if count != trials:
                raise BoardError(f"{path}: runs: {operator} measured {board} {count} times, others measured boards {trials} times: give "
                                 "every operator every board as often")
    parts, left_out = [], []
    for board in boards:
        cells = [found[board, operator] for operator in operators]
        for name in dict.fromkeys(name for cell in cells for run in cell for name in run):
            entries = [[run.get(name, {}) for run in cell] for cell in cells]
            if any(entry.get("deviation_m") is None for cell in entries for entry in cell):
                left_out.append(f"{board} {name}")
                continue
            low, high = entries[0][0]["tolerance_m"]
            values, sigmas = (np.array([[entry[key] for entry in cell] for cell in entries], dtype=np.float64)
                              for key in ("deviation_m", "sigma_m"))
            parts.append(_Part(board, name, values, sigmas, high - low))
    if not parts:
        raise BoardError(f"{path}: no region was measured in every run")
    return parts, left_out


def _table(parts: list[_Part]) -> str:
    return table_text(COLUMNS, (
        [part.board, part.region, f"{part.values.mean():.6g}",
         f"{np.sqrt(part.values.var(axis=1, ddof=1).mean()) if part.values.shape[1] > 1 else 0:.6g}",
         f"{np.sqrt(np.square(part.sigmas).mean()):.6g}", " ".join(f"{value:.6g}" for value in part.values.ravel())] for part in parts))


def gauge_study(values: np.ndarray) -> GaugeStudy:
    """Divide the variance of a crossed study into its parts.
    `values`: [parts, operators, trials], two parts or more and two trials or more. Raises ValueError if there are fewer parts or trials."""
    parts, operators, trials = values.shape
    if parts < 2 or trials < 2:
        raise ValueError(f"there are {parts} parts and {trials} trials: two or more of each are needed")
    mean = values.mean()
    by_part, by_operator, by_cell = values.mean(axis=(1, 2)), values.mean(axis=(0, 2)), values.mean(axis=2)
    part_square = operators * trials * float(((by_part - mean) ** 2).sum()) / (parts - 1)
    error, freedom = float(((values - by_cell[..., None]) ** 2).sum()), parts * operators * (trials - 1)
    if operators == 1:
        repeat = error / freedom
        part = max((part_square - repeat) / trials, 0.0)
        times = part_square / (repeat * _f(parts - 1, freedom)) if repeat > 0 else math.inf
        return _study(repeat, None, None, part, freedom, repeat * (1 + _rise(freedom)), (times - 1) / trials)
    operator_square = parts * trials * float(((by_operator - mean) ** 2).sum()) / (operators - 1)
    crossed = trials * float(((by_cell - by_part[:, None] - by_operator[None] + mean) ** 2).sum())
    crossed_freedom = (parts - 1) * (operators - 1)
    interaction: float | None = None
    repeat, base = error / freedom, crossed / crossed_freedom
    bound, ratio = _bounds(values.shape, part_square, operator_square, base, repeat)
    if repeat == 0 or fdtrc(crossed_freedom, freedom, base / repeat) < POOL_PROBABILITY:
        interaction = max((base - repeat) / trials, 0.0)
    else:
        freedom += crossed_freedom
        repeat = base = (error + crossed) / freedom
    operator = max((operator_square - base) / (parts * trials), 0.0)
    part = max((part_square - base) / (operators * trials), 0.0)
    return _study(repeat, operator + (interaction or 0.0), interaction, part, freedom, bound, ratio)


def _f(freedom: int, other: int) -> float:
    """Return what an F-distributed ratio is below with the probability SURE."""
    return float(fdtri(freedom, other, SURE))


def _rise(freedom: int) -> float:
    """Return by which part of its estimate a variance may be larger, with the probability SURE."""
    return freedom / float(chi2.ppf(1 - SURE, freedom)) - 1


def _bounds(shape: tuple[int, ...], part: float, operator: float, crossed: float, repeat: float) -> tuple[float, float]:
    """Return the upper bound of the gauge's variance, and the lower bound of the variance of parts over it.
    `shape`: parts, operators, trials. The others: mean squares of the study, with an interaction that is not pooled."""
    parts, operators, trials = shape
    terms = np.array([operator, (parts - 1) * crossed, parts * (trials - 1) * repeat])
    rises = np.array([_rise(freedom) for freedom in (operators - 1, (parts - 1) * (operators - 1), parts * operators * (trials - 1))])
    bound = float(terms.sum() + np.sqrt(((rises * terms) ** 2).sum())) / (parts * trials)
    least = (parts - 1) / float(chi2.ppf(SURE, parts - 1))  # a mean square of parts is so many times its expectation at least
    above = part - _f(parts - 1, (parts - 1) * (operators - 1)) * crossed
    below = terms[1] + terms[2] + least * _f(parts - 1, operators - 1) * operator
    return bound, parts * least * above / (operators * below) if below > 0 else math.inf


def _study(repeat: float, operator: float | None, interaction: float | None, part: float, freedom: int, bound: float, ratio: float
           ) -> GaugeStudy:
    """Return a study of variances. `bound`: the most that the gauge's may be. `ratio`: the least that the parts' may be over it."""
    gauge, root = repeat + (operator or 0.0), math.sqrt
    total = root(gauge + part)
    most = max(100 / root(1 + max(ratio, 0.0)), 100 * root(gauge) / total if total > 0 else 0.0)
    return GaugeStudy(root(repeat), None if operator is None else root(operator), None if interaction is None else root(interaction),
                      root(gauge), root(part), total, freedom, root(max(bound, gauge)), most)
