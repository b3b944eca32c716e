"""What the service adds to a relight: the same frames by `relit relight` and as a job, one after the other and in turns.

    python -m benchmarks.service_overhead [--frames N] [--repeats N]
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from benchmarks.service_process import SAMPLES, running
from service.client import Client
from service.requests.jobs import RelightJob
from service.requests.relight import RelightOptions

OWL, SKY = SAMPLES / "owl", SAMPLES / "owl" / "environment.exr"
HEAD = ("| frames | `relit relight`, s | job, submitted to finished, s | ratio | job, started to finished, s | ratio |\n"
        "|---|---|---|---|---|---|")


class Pair(NamedTuple):
    """Seconds of the same work done both ways, one right after the other."""

    command: float
    submitted: float
    """From before the job was handed in to when the client knew that it had ended."""
    started: float
    """Seconds of the job alone, from its start to its end as the service records them."""


def command(folder: Path, frames: int) -> float:
    """`relit relight` in a process of its own, frames made anew."""
    began = time.perf_counter()
    subprocess.run([sys.executable, "-m", "service.cli.main", "relight", str(OWL), "--environment", str(SKY), "--frames", f"1-{frames}",
                    "--spin-degrees", "360", "--cache", str(folder / "cache"), "--device", "cpu", "--overwrite",
                    "--out", str(folder / "frames" / "frame.####.exr")], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - began


def job(client: Client, capture: str, environment: str, frames: int) -> tuple[float, float]:
    """The same as a job of a warm worker: seconds from its submission, and from its start."""
    began = time.perf_counter()
    made = client.jobs.submit(RelightJob(kind="relight", capture=capture, environment=environment,
                                         options=RelightOptions(frames=f"1-{frames}", spin_degrees=360)))
    ended = client.jobs.wait(made.id)
    spent = time.perf_counter() - began
    assert ended.started_at is not None and ended.finished_at is not None
    client.jobs.delete(made.id)
    return spent, (ended.finished_at - ended.started_at).total_seconds()


def pairs(frames: int, repeats: int) -> list[Pair]:
    """Both ways in turns; one of each before, which is not counted, fills the caches and wakes the worker."""
    found = []
    with tempfile.TemporaryDirectory() as name, running(Path(name) / "service") as service, Client(service.url, service.key) as client:
        folder = Path(name)
        capture, environment = client.captures.register(str(OWL)).id, client.environments.register(str(SKY)).id
        for turn in range(repeats + 1):
            seconds = command(folder, frames)
            pair = Pair(seconds, *job(client, capture, environment, frames))
            if turn:
                found.append(pair)
                print(f"command {pair.command:.2f} s, job {pair.submitted:.2f} s, of which started {pair.started:.2f} s", file=sys.stderr)
    return found


def overhead_rows(frames: int = 120, repeats: int = 5) -> list[str]:
    """A table: medians, and the spread of the ratios of single pairs."""
    found = pairs(frames, repeats)

    def ratio(values: list[float]) -> str:
        return f"{statistics.median(values):.3f} ({min(values):.3f} to {max(values):.3f})"

    commands, submitted, started = zip(*found, strict=True)
    ratios = [[one / other for one, other in zip(seconds, commands, strict=True)] for seconds in (submitted, started)]
    return [HEAD, f"| {frames} | {statistics.median(commands):.2f} | {statistics.median(submitted):.2f} | {ratio(ratios[0])} | "
                  f"{statistics.median(started):.2f} | {ratio(ratios[1])} |"]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--repeats", type=int, default=5)
    given = parser.parse_args()
    print("\n".join(overhead_rows(given.frames, given.repeats)))
