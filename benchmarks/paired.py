"""Processor seconds of products on the CPU beside those of an older version, run by turns: a section of docs/figures.md.

    git worktree add /tmp/before 1fd8e08f && python -m benchmarks.figures --only paired --before /tmp/before

Seconds of the clock tell little on a machine that other work shares; processor seconds, of all threads and children, tell what was done.
"""

import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from statistics import median

SAMPLES = Path(__file__).parents[1] / "samples"
PAIRS = 5
FRAMES = 48
"""Frames of a spin of the shipped owl."""


def _solve(method: str) -> Callable[[Path], None]:
    def run(work: Path) -> None:
        from service.requests.solve import Method, SolveRequest
        from service.solve.solve import solve
        solve(SolveRequest(capture=SAMPLES / "owl", out=work / method, method=Method(method), cache=work / "cache"))
    return run


def _relight(*, guided: bool) -> Callable[[Path], None]:
    def run(work: Path) -> None:
        from service.relight.relight import relight
        from service.requests.relight import LightWeights, RelightRequest
        relight(RelightRequest(capture=SAMPLES / "owl", environment=SAMPLES / "owl" / "environment.exr",
                               out=str(work / f"{guided}.####.exr"),
                               frames=f"1-{FRAMES}", spin_degrees=360, weights=None if guided else LightWeights.CELLS,
                               maps=work / "svbrdf" if guided else None, cache=work / "cache"))
    return run


def _depth(work: Path) -> None:
    from service.depth.depth import depth
    from service.requests.depth import DepthRequest
    depth(DepthRequest(capture=SAMPLES / "rig", out=work / "depth", cache=work / "cache"))


WORKS: dict[str, Callable[[Path], None]] = {
    "`solve --method robust`, `samples/owl`, from files": _solve("robust"),
    "`solve --method svbrdf`": _solve("svbrdf"),
    f"{FRAMES} relit frames, cells": _relight(guided=False),
    f"{FRAMES} relit frames, guided by the maps": _relight(guided=True),
    "`depth`, `samples/rig`, from files": _depth,
}


def used() -> float:
    """Return the processor seconds of this process and its ended children so far."""
    return sum(found.ru_utime + found.ru_stime for found in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))


def _seconds(tree: Path) -> list[float]:
    """Return what each work takes in a process of the version, by the modules of a checkout, with one thread of BLAS as commands have."""
    return [float(line) for line in subprocess.run(
        [sys.executable, "-P", __file__], check=True, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(tree), "OPENBLAS_NUM_THREADS": "1"}).stdout.split()]


def paired_rows(before: Path) -> list[str]:
    """Return the section as lines of Markdown."""
    now = Path(__file__).parents[1]
    commit = subprocess.run(["git", "-C", str(before), "log", "-1", "--format=%h of %cs"], check=True, capture_output=True,
                            text=True).stdout
    _seconds(before), _seconds(now)  # compile what is not cached
    rounds = [(_seconds(before), _seconds(now)) for _ in range(PAIRS)]
    lines = [f"Processor seconds on the CPU, of all threads and child processes, by turns with commit {commit.strip()}, the last before "
             f"work for GPUs without a GPU began: {PAIRS} pairs. What features added since then take is part of it.", "",
             "| work | before, s, median | now, s, median | ratio, median | least | greatest |", "|---|---|---|---|---|---|"]
    for number, name in enumerate(WORKS):
        then, since = ([which[number] for which in side] for side in zip(*rounds, strict=True))
        ratios = [b / a for a, b in zip(then, since, strict=True)]
        lines.append(f"| {name} | {median(then):.2f} | {median(since):.2f} | {median(ratios):.3f} | {min(ratios):.3f} | "
                     f"{max(ratios):.3f} |")
    return lines


def main() -> None:
    """Print the processor seconds of each work, by the modules that are found first."""
    with tempfile.TemporaryDirectory() as folder:
        for run in WORKS.values():
            began = used()
            run(Path(folder))
            print(used() - began, flush=True)


if __name__ == "__main__":
    main()
