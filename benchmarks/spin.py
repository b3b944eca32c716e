"""A turn of the environment in 240 frames of the shipped sample: where the time goes, from captured files to relit ones."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.accuracy import SAMPLES
from service.cli.main import BLAS_THREADS
from service.relight.relight import relight
from service.requests.light.picture_options import FrameCompression
from service.requests.relight import LightWeights, RelightRequest
from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve

FRAMES = 240
PARTS = ("ingest", "guide", "weights", "product", "waiting for files")


def spin_table() -> list[str]:
    """Return the table as lines of Markdown, measured in a process whose BLAS has one thread, as that of a command has."""
    return subprocess.run([sys.executable, "-m", __name__], check=True, capture_output=True, text=True,
                          env={**os.environ, BLAS_THREADS[0]: "1"}).stdout.splitlines()


def _measured() -> list[str]:
    lines = [f"`samples/owl`, {FRAMES} frames, 320 × 320, 96 lights, from EXR to half EXR; seconds. Threads write files "
             "meanwhile; `waiting` is the time that is spent waiting for them.", "",
             "| | decode and stack | guide | weights | product | waiting | whole | MB |", "|---|---|---|---|---|---|---|---|"]
    sample = SAMPLES / "owl"
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        solve(SolveRequest(capture=sample, out=work / "maps", method=Method.SVBRDF, cache=work / "solve"))
        relight(RelightRequest(capture=sample, environment=sample / "environment.exr", out=str(work / "warm.#.exr"), cache=work / "solve",
                               maps=work / "maps"))
        for title, weights, compression, maps in (("kernel, zip", LightWeights.KERNEL, FrameCompression.ZIP, None),
                                                  ("cells, zip", LightWeights.CELLS, FrameCompression.ZIP, None),
                                                  ("smooth, zip", LightWeights.SMOOTH, FrameCompression.ZIP, None),
                                                  ("smooth, dwaa", LightWeights.SMOOTH, FrameCompression.DWAA, None),
                                                  ("guided, zip", None, FrameCompression.ZIP, work / "maps")):
            out, cache = work / title.replace(", ", "-"), work / f"cache-{title}"
            began = time.perf_counter()
            result = relight(RelightRequest(
                capture=sample, environment=sample / "environment.exr", out=str(out / "f.####.exr"), frames=f"1-{FRAMES}",
                spin_degrees=360, weights=weights, compression=compression, maps=maps, cache=cache, report=out / "report.json"))
            whole = time.perf_counter() - began
            parts = json.loads((out / "report.json").read_text())["timings_s"]["of these"]
            size = sum(path.stat().st_size for path in result.frames) / 1e6
            lines.append(f"| {title} | " + " | ".join(f"{parts.get(part, 0):.2f}" for part in PARTS) + f" | {whole:.1f} | {size:.0f} |")
    return lines


if __name__ == "__main__":
    print("\n".join(_measured()))
