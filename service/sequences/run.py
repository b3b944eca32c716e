"""A solve or a depth of a sequence: its steps one after another, each joined with those before, and a report over all of them."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, report
from service.requests.depth import DepthRequest
from service.requests.solve import SolveRequest
from service.sequences.joined_steps import DepthJoiner, MapsJoiner, moved_points
from service.sequences.steps import ALONE, StepProgress, check_outputs, depth_alone, shared_lights, solve_alone, step_report
from stage.capture.light import PointLight
from stage.capture.sequence import SEQUENCE_FILE, Sequence, TimeStep, check_alike, is_sequence, read_sequence, write_sequence
from stage.errors import ResultError
from stage.files import write_text
from stage.formats.ply import POINTS_FILE, read_ply, write_ply
from stage.results.depth_maps import DEPTH_FILE, DepthMaps
from stage.results.maps import MAPS_FILE, SurfaceMaps

FIGURES = re.compile(r"\d[\d.]*")
"""The numbers in a sentence, which may differ between steps whose sentences say the same."""
UNTIMED = "the steps are folders in order of name, taken at {:g} a second: a sequence.json says the rate and times"
"""The warning in the report about a sequence without a file."""
BRIGHTER = ("albedo: is {:.3g} times that of the steps before, by one factor where the normals agree, and is not joined with it: check "
            "exposure_s and the lights of the steps")
"""The warning about a step whose albedo is another one by a factor."""
OF_LIGHTS = ("found", "suspect_lights")
"""Entries that the report of a joined step repeats from that of the step alone: the lights under which its model is to be looked at."""


class SequenceResult(NamedTuple):
    """Files and statistics of a solved sequence."""

    sequence_path: Path
    report_path: Path
    names: tuple[str, ...]
    kept: int
    """Steps that were done before."""
    joined: float | None
    """Share of the pixels with an estimate in two consecutive steps that agreed, over all steps; None: each step stands alone."""
    solved: int
    """Pixels of all steps."""
    warnings: tuple[str, ...]


class _Step(NamedTuple):
    facts: dict[str, Any]
    solved: int
    warnings: list[str]


def solve_sequence(request: SolveRequest, progress: Progress | None = None) -> SequenceResult:
    """Solve every capture of a sequence, and join what agrees from step to step.
    `request`: its `capture` is the sequence, its `out` the folder for a folder of each step. Raises RequestError if lights are to be found
    from the images of each step, or results would lie in a capture. Raises StageError or KernelError: bad input; the steps before are
    whole."""
    lights = shared_lights(request)
    sequence, manifests = _open(request)
    near = any(isinstance(frame.light, PointLight) for manifest in manifests for frame in manifest.frames)
    joiner = MapsJoiner(anchored=not near)

    def one(step: TimeStep, folder: Path, told: StepProgress) -> tuple[_Step, bool]:
        there, was_done = solve_alone(request, step, told, lights)
        alone = SurfaceMaps.read(there.out / MAPS_FILE, unsure=True)
        facts: dict[str, Any] = {}
        if request.temporal:
            if alone.normal is None or alone.sigma is None:
                raise ResultError(f"{there.out / MAPS_FILE}: has no normals with their standard errors: delete the folder and run again")
            joined, facts = joiner.join(alone)
            joined.write(folder / MAPS_FILE)
        return _finish(request, step, folder, there.out, alone.mask, facts), was_done

    return _run(request, sequence, progress, one, MAPS_FILE)


def depth_sequence(request: DepthRequest, progress: Progress | None = None) -> SequenceResult:
    """Measure the depth of every capture of a sequence, and join what agrees from step to step; as solve_sequence.
    Raises ResultError if a step is decoded and cannot be triangulated."""
    sequence, _ = _open(request)
    joiner = DepthJoiner()

    def one(step: TimeStep, folder: Path, told: StepProgress) -> tuple[_Step, bool]:
        there, was_done = depth_alone(request, step, told)
        alone = DepthMaps.read(there.out / DEPTH_FILE, unsure=True)
        facts: dict[str, Any] = {}
        if request.temporal:
            joined, facts = joiner.join(alone)
            cloud = moved_points(read_ply(there.out / POINTS_FILE), alone, joined)
            joined.write(folder / DEPTH_FILE)
            write_ply(cloud, folder / POINTS_FILE, comments=tuple(f"{key} {value}" for key, value in joined.provenance.items()))
        return _finish(request, step, folder, there.out, alone.mask, facts), was_done

    return _run(request, sequence, progress, one, DEPTH_FILE)


def _open(request: SolveRequest | DepthRequest) -> tuple[Sequence, list[Any]]:
    assert is_sequence(request.capture)
    sequence = read_sequence(request.capture, frames_per_second=request.frame_rate)
    manifests = check_alike(sequence)
    check_outputs(request.out, sequence)
    return sequence, manifests


def _finish(request: Any, step: TimeStep, folder: Path, alone: Path, mask: np.ndarray, facts: dict[str, Any]) -> _Step:
    """Write the report of a joined step, and return what the report of the sequence says of it."""
    found = step_report(alone)
    pixels, warnings = found.get("pixels", {}), [str(sentence) for sentence in found.get("warnings", [])]
    warnings += [BRIGHTER.format(facts["brightness_apart"])] if "brightness_apart" in facts else []
    if request.temporal:
        write_text(folder / REPORT_FILE, report(
            request.model_copy(update={"capture": step.folder}),
            inputs=found.get("inputs", {}), method=found.get("method"), joined=facts, alone=f"{ALONE}/{REPORT_FILE}", warnings=warnings,
            pixels=pixels, **{name: found[name] for name in OF_LIGHTS if name in found}))
    told = {"name": step.name, "time_s": round(step.time_s, 6), "method": found.get("method"),
            "pixels": {"mask": pixels.get("mask", 0), "solved": int(np.count_nonzero(mask))}, **facts}
    return _Step(told, int(np.count_nonzero(mask)), warnings)


def _run(request: Any, sequence: Sequence, progress: Progress | None, one: Callable[..., tuple[_Step, bool]],
         result: str) -> SequenceResult:
    timings = Timings(progress)
    rows: list[dict[str, Any]] = []
    warnings: list[str] = []
    if request.temporal and not sequence.timed and request.frame_rate is None:
        warnings.append(UNTIMED.format(sequence.frames_per_second))
    kept = solved = agreed = compared = 0
    methods: dict[str, str] = {}
    said: dict[str, list[str]] = {}
    for number, step in enumerate(sequence.steps, start=1):
        found, was_done = one(step, request.out / step.name, StepProgress(timings, number, len(sequence.steps)))
        rows.append(found.facts | {"done_before": was_done})
        kept += was_done
        solved += found.solved
        agreed += found.facts.get("joined_pixels", 0)
        compared += found.facts.get("compared_pixels", 0)
        methods.setdefault(str(found.facts["method"]), step.name)
        for sentence in found.warnings:
            said.setdefault(FIGURES.sub("", sentence), []).append(f"{step.name}: {sentence}")
    warnings += [first if not others else f"{first} (and {len(others)} more of {len(rows)} steps, with other figures)"
                 for first, *others in said.values()]
    if len(methods) > 1:
        warnings.append("the steps are not of one method: " + ", ".join(f"{method} from {name} on" for method, name in methods.items())
                        + ": give the method")
    results = sequence._replace(steps=tuple(step._replace(folder=request.out / step.name) for step in sequence.steps))
    write_sequence(results, request.out / SEQUENCE_FILE)
    report_path = request.out / REPORT_FILE
    write_text(report_path, report(
        request,
        inputs={"sequence": str(request.capture), "steps": len(rows), "frames_per_second": sequence.frames_per_second},
        result=result,
        joined=request.temporal,
        steps=rows,
        warnings=warnings,
        timings_s=timings.close(),
    ))
    share = (agreed / compared if compared else 0.0) if request.temporal else None
    return SequenceResult(request.out / SEQUENCE_FILE, report_path, tuple(step.name for step in sequence.steps), kept, share, solved,
                          tuple(warnings))
