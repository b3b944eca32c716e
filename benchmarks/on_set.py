"""Captures on the set: faults that are named over random seeds, Relit's own time for a picture, and the time until the preview.

    python -m benchmarks.on_set      prints the tables of docs/figures.md
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np

from service.acquisition.acquire import acquire, refuse_to_ask
from service.acquisition.checks.expectation import FaultKind
from service.acquisition.early_ingest import PREVIEW_FILE
from service.acquisition.plans.plan import read_plan
from service.requests.acquire import AcquireRequest
from tests.service.acquisition.scenes import KINDS, Scene, named, owl, owl_on_stage, relief
from tests.service.acquisition.test_acquire import faults_at_random
from tests.service.acquisition.twin_in_process import TwinInProcess, wanted
from tests.service.acquisition.twin_in_process import named as names_of
from tests.service.twin_program import ROOT

SEEDS = range(20)
TWIN_SEEDS = range(6)
"""Whole captures of 97 pictures with their files take longer."""
SCENES: dict[str, tuple[int, Callable[[int], Scene]]] = {
    "the shipped owl": (96, lambda seed: owl()), "one relief": (34, lambda seed: relief(5)), "a relief for each seed": (34, relief)}
PIXELS, CROP, CAPTURES = 60_000, "10,60,300,200", 2


def fault_rows() -> list[str]:
    """Return the rows of the captures whose faults are exactly those that were made."""
    rows = []
    for name, (lamps, scene) in SCENES.items():
        for kinds in (KINDS, ()):
            right = [found == made for made, found in (named(scene(seed), seed, kinds) for seed in SEEDS)]
            rows.append(f"| {name}, {lamps} lamps | {_said(kinds)} | {sum(right)} of {len(right)} |")
    right = []
    for seed in SEEDS:
        with tempfile.TemporaryDirectory() as folder:
            made, found = faults_at_random(Path(folder), seed)
            right.append(found == made)
    kinds = (FaultKind.DOUBLED, FaultKind.MISSING, FaultKind.CLIPPED, FaultKind.LATE)
    return [*rows, f"| six lamps, whole captures | {_said(kinds)} | {sum(right)} of {len(right)} |", *twin_rows()]


def twin_rows() -> list[str]:
    """Return the rows of whole captures of the owl's twin, in which pictures with faults are taken again."""
    right: dict[str, list[bool]] = {}
    with tempfile.TemporaryDirectory() as folder:
        twin = TwinInProcess(Path(folder))
        for seed in TWIN_SEEDS:
            for faults in (twin.faults(seed), {}):
                result = twin.capture(f"{seed}_{len(faults)}", seed, faults)
                right.setdefault("all nine of the twin" if faults else "none", []).append(
                    names_of(result.retaken) == wanted(faults) and result.faults == ())
    return [f"| the twin of the owl, whole captures | {name} | {sum(each)} of {len(each)} |" for name, each in right.items()]


def time_row(picture_format: str) -> str:
    """Return the row of a format of pictures: the least times of several captures."""
    measured = np.array([times(picture_format) for _ in range(CAPTURES)])
    own, computed, preview = measured.min(axis=0)
    return f"| {picture_format} | {own:.0f} ms | {computed:.0f} ms | {preview:.1f} s |"


def times(picture_format: str) -> tuple[float, float, float]:
    """Return the milliseconds of the median picture, those of them that were computed, and the seconds from the last one to the preview."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        capture = folder / "capture"
        with owl_on_stage(folder, "--crop", CROP, "--picture-format", picture_format) as given:
            subprocess.run([sys.executable, "-m", "service.cli.main", "capture", "dark,olat", *map(str, given), "--out", str(capture)],
                           cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, check=True, stdout=sys.stderr)  # what has a fault is said
            _, rig, _, camera, _, trigger = map(str, given)
            request = AcquireRequest(plan="dark,olat", rig=Path(rig), camera=camera, trigger=trigger, out=folder / "again")
            with mock.patch.object(time, "perf_counter", time.thread_time):  # which stands still while nothing is computed
                computed = float(np.median(acquire(request, refuse_to_ask).own_s)) + read_plan(request.plan).settle_s
        lines = [json.loads(line) for line in (capture / "acquisition.jsonl").read_text().splitlines()]
        last = max(line["time"] for line in lines if line.get("event") == "taken")
        own = json.loads((capture / "report.json").read_text())["own_ms"]["median"]
        return own, 1e3 * computed, (capture / PREVIEW_FILE).stat().st_mtime - last


def fault_table() -> list[str]:
    """Return the section of docs/figures.md on faults."""
    return [f"Captures whose faults are named with their pictures and none else, over {len(SEEDS)} seeds that choose noise and places "
            f"({len(TWIN_SEEDS)} of the twin). Where a capture has no fault, none is named while it is taken either.", "",
            "| object | faults in each capture | right |", "|---|---|---|", *fault_rows()]


def time_table() -> list[str]:
    """Return the section of docs/figures.md on times."""
    return [f"A dark picture and 96 of {PIXELS} pixels under single lamps, from the twin through a watched folder. Own: the median picture "
            "beside exposure, transfer and settling. Preview: from the last picture, over the last judgement of all, to `preview.png`. "
            f"The least of {CAPTURES} captures each, at a load of {os.getloadavg()[2]:.0f} processes.", "",
            "| pictures | own (bar: 50 ms) | computed of it | preview (bar: 10 s) |", "|---|---|---|---|", *map(time_row, ("exr", "png"))]


def _said(kinds: tuple[FaultKind, ...]) -> str:
    return ", ".join(str(kind).replace("_", " ") for kind in kinds) or "none"


if __name__ == "__main__":
    print("\n".join([*fault_table(), "", *time_table()]))
