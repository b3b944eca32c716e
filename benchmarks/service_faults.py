"""What the service loses when its processes are killed, hang or are without their database: the table of docs/service_faults.md.

python -m benchmarks.service_faults [--seed N] [--kills] [--sqlite | --write docs/service_faults.md]; some minutes. Without --sqlite it
needs the server programs of PostgreSQL, and repeats the kills on SQLite; with it everything is on SQLite, without the restarts of
PostgreSQL. With --kills there are only the kills, and --write replaces their section of the document, which ends it.
"""

import argparse
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.requests.base.identifiers import CAPTURE, ENVIRONMENT
from service.server.database import jobs, workers
from tests.scenes.captures import make_scene, write_capture, write_exr
from tests.service.postgres import Postgres, binaries, postgres
from tests.service.server.jobs.harness import Harness, digests, harness, relit_relight

FRAMES, SIZE, LIGHTS, CHUNK_FRAMES, WORKERS = 200, 1024, 6, 8, 3
TAKEOVER_LIMIT_S = 10.0
STALL_S = 5.0
AT_WORK, WITH_SUPERVISOR, SUPERVISOR, IDLE = (
    "SIGKILL of the worker at work", "SIGKILL of the worker at work and of the `relit worker` over it, as when a machine dies",
    "SIGKILL of the `relit worker` over the worker at work", "SIGKILL of a worker that waits")
KILLS = {AT_WORK: 15, WITH_SUPERVISOR: 8, SUPERVISOR: 3, IDLE: 4}
"""30, in random order."""


TOGETHER = "**these together, in one job, in random order"
KILLS_BEGIN, KILLS_END = "<!-- kills: made by benchmarks.service_faults -->", "<!-- end of kills -->"
NewDatabase = Callable[[], str | None]
"""Returns the URL of an empty database; None: SQLite in the data folder."""


class Fault(NamedTuple):
    """A row of the table."""

    kind: str
    times: int
    frames: int
    """Frames that the disturbed jobs made; each has to exist once, complete."""
    identical: int
    """How many of them equal those of `relit relight`, bit by bit."""
    takeovers_s: Sequence[float]
    """From the fault until another worker has the job."""
    lost: int
    """Jobs that did not succeed."""


class Scene(NamedTuple):
    """What is relit, and the digests of its frames when nothing disturbs the job."""

    capture: Path
    environment: Path
    digests: dict[str, str]


def make_scene_files(folder: Path) -> Scene:
    capture = write_capture(folder / "capture", make_scene(size=SIZE, lights=LIGHTS))
    environment = write_exr(folder / "sky.exr", np.random.default_rng(7).random((16, 32, 3)))
    return Scene(capture, environment, relit_relight(capture, environment, FRAMES, folder / "frames"))


def submit(made: Harness, scene: Scene) -> str:
    return made.relight(made.register(scene.capture, CAPTURE), made.register(scene.environment, ENVIRONMENT), FRAMES,
                        chunk_frames=CHUNK_FRAMES)


def settle(made: Harness, scene: Scene, job: str) -> tuple[int, int, int]:
    """Wait for the job: frames that were to be there, those that are as undisturbed, jobs lost."""
    row = made.ended(job, within_s=600)
    there = digests(made.results(job))
    assert there.keys() <= scene.digests.keys(), f"besides the frames: {sorted(there.keys() - scene.digests.keys())}"
    made.until(lambda: made.queue.taken_by() == {}, "left by everybody")
    made.never_two_at_once(job)
    return FRAMES, sum(there.get(name) == digest for name, digest in scene.digests.items()), int(row["state"] != jobs.SUCCEEDED)


def tell(made: Harness, job: str, kind: str, took: float | None) -> None:
    print(f"{made.frames_there(job):4d} frames  {'        ' if took is None else f'{took:6.2f} s'}  {kind}", flush=True)


def taken_over(made: Harness, job: str, victim: str) -> float:
    """Seconds until another worker has the job."""
    began = time.monotonic()
    made.holder(job, other_than=victim)
    return time.monotonic() - began


def machine_of(made: Harness, pid: int) -> "subprocess.Popen[bytes]":
    """The `relit worker` over a worker; both are in a process group of their own."""
    return next(process for process in made.supervisors if process.pid == os.getpgid(pid))


def kill(made: Harness, job: str, kind: str, chance: random.Random) -> float | None:
    """One kill; how long it took until the job was taken over, None where it need not be."""
    holder = made.holder(job)
    if kind == IDLE:
        others = made.until(lambda: [row for row in workers.seen_lately(made.database) if row["id"] != holder and _lives(row["pid"])],
                            "a worker that waits")
        os.kill(chance.choice(others)["pid"], signal.SIGKILL)
        return None
    pid = made.pid_of(holder)
    if kind == AT_WORK:
        os.kill(pid, signal.SIGKILL)
        return taken_over(made, job, holder)
    machine = machine_of(made, pid)
    if kind == SUPERVISOR:
        os.kill(machine.pid, signal.SIGKILL)
    else:
        os.killpg(machine.pid, signal.SIGKILL)
    machine.wait()
    made.start()
    return taken_over(made, job, holder)


def _lives(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def kills(folder: Path, new_database: NewDatabase, scene: Scene, chance: random.Random, where: str) -> list[Fault]:
    """The 30 kills in one job, with the default settings: each when so many frames are there, and up to a second later."""
    order = [kind for kind, times in KILLS.items() for _ in range(times)]
    chance.shuffle(order)
    frames = sorted(chance.randrange(FRAMES * 3 // 4) for _ in order)
    takeovers: dict[str, list[float]] = {kind: [] for kind in KILLS}
    with harness(folder, new_database(), roots=str(scene.capture.parent)) as made:
        for _ in range(WORKERS):
            made.start()
        made.ready(WORKERS)
        job = submit(made, scene)
        for kind, at in zip(order, frames, strict=True):
            made.until(lambda at=at: made.frames_there(job) >= at, f"{at} frames")
            time.sleep(chance.uniform(0, 1))
            took = kill(made, job, kind, chance)
            tell(made, job, kind, took)
            takeovers[kind] += [] if took is None else [took]
        wanted, identical, lost = settle(made, scene, job)
    rows = [Fault(kind, times, 0, 0, takeovers[kind], 0) for kind, times in KILLS.items()]
    dead = [each for kind in KILLS if kind != SUPERVISOR for each in takeovers[kind]]
    assert lost == 0 and identical == wanted, f"{lost} jobs lost, {identical} of {wanted} frames are identical"
    return [*rows, Fault(f"{TOGETHER}, on {where}**", len(order), wanted, identical, dead, lost)]


def disturbed(folder: Path, new_database: NewDatabase, scene: Scene, kind: str, times: int,
              disturb: Callable[[Harness, str], float | None], *, environment: dict[str, str] | None = None, **settings: float) -> Fault:
    """A job during which something happens so many times, evenly over its frames."""
    takeovers: list[float] = []
    with harness(folder, new_database(), roots=str(scene.capture.parent), **settings) as made:
        for _ in range(WORKERS):
            made.start(**(environment or {}))
        made.ready(WORKERS)
        job = submit(made, scene)
        for number in range(times):
            made.until(lambda at=(2 * number + 1) * FRAMES // (2 * times + 1): made.frames_there(job) >= at, "that many frames")
            took = disturb(made, job)
            takeovers += [] if took is None else [took]
            tell(made, job, kind, took)
        wanted, identical, lost = settle(made, scene, job)
        return Fault(kind, times, wanted, identical, takeovers, lost)


def kill_all(made: Harness, job: str) -> float:
    holder = made.holder(job)
    for process in made.supervisors:
        if process.poll() is None:
            for row in workers.seen_lately(made.database):
                if _lives(row["pid"]) and os.getpgid(row["pid"]) == process.pid:
                    os.kill(row["pid"], signal.SIGKILL)
    return taken_over(made, job, holder)


def stop_one(made: Harness, job: str) -> float:
    holder = made.holder(job)
    os.kill(made.pid_of(holder), signal.SIGSTOP)
    return taken_over(made, job, holder)


def ask_one_to_end(made: Harness, job: str) -> float:
    holder = made.holder(job)
    machine = machine_of(made, made.pid_of(holder))
    machine.send_signal(signal.SIGTERM)
    took = taken_over(made, job, holder)
    assert machine.wait(30) == 0
    made.start()
    made.ready(WORKERS)
    return took


def restarted(server: Postgres, mode: str, away_s: float) -> Callable[[Harness, str], None]:
    def restart(made: Harness, job: str) -> None:
        before = made.row(job)["worker"]
        server.restart(mode, away_s=away_s)
        time.sleep(3 * made.settings.takeover_s)
        assert made.row(job)["worker"] == before or made.row(job)["state"] in jobs.ENDED, "a worker that lives was given up for dead"

    return restart


def table(faults: list[Fault]) -> list[str]:
    lines = ["| fault | times | frames | identical | another worker has the job after (median / longest) | jobs lost |",
             "|---|---:|---:|---:|---:|---:|"]
    for fault in faults:
        took = fault.takeovers_s
        lines.append(f"| {fault.kind} | {fault.times} | {fault.frames or ''} | {fault.identical if fault.frames else ''} "
                     f"| {f'{statistics.median(took):.1f} s / {max(took):.1f} s' if took else ''} | {fault.lost if fault.frames else ''} |")
    return lines


def of_kills(fault: Fault) -> bool:
    return fault.kind in KILLS or fault.kind.startswith(TOGETHER)


def processor() -> str:
    with open("/proc/cpuinfo") as file:
        return next((line.partition(":")[2].strip() for line in file if line.startswith("model name")), "unknown")


def document(faults: list[Fault], seed: int, seconds: float, load: float) -> str:
    return f"""# Faults of the service, measured

*After reading this page you can say which faults the service survives, and after how long.*

Measured on {datetime.now(UTC):%Y-%m-%d} on {os.cpu_count()} cores ({processor()}; load average before it began
{load:.1f}) in {seconds / 60:.0f} minutes, seed {seed}, by

    python -m benchmarks.service_faults --write docs/service_faults.md

Each row is a relight of {FRAMES} frames ({SIZE} × {SIZE}, {LIGHTS} lights, {CHUNK_FRAMES} frames in each step) with {WORKERS} workers
on a private PostgreSQL, during which faults happen. A frame is
*identical* if its file equals, bit by bit, the file that `relit relight` makes undisturbed. The script fails if a frame
is missing or different, if there is any other file (hidden ones too), if two workers had one job at the same time, if a
job is lost or left over in the queue, or if a takeover from a killed worker takes {TAKEOVER_LIMIT_S:g} s or longer.
All settings have their defaults, except `stall_s` in the row of SIGSTOP. `tests/service/server/jobs` has these
faults at small size, and others: a job
that kills its workers, a full disk, a killed API.

{chr(10).join(table([fault for fault in faults if not of_kills(fault)]))}

A worker that hangs is killed after `stall_s`, here {STALL_S:g} s, and its time contains that. A worker that is asked to stop, or
whose `relit worker` is killed, first finishes its step and then returns the job to the queue, and its time contains that. When
PostgreSQL restarts, the workers keep their jobs.
"""


def kills_section(faults: list[Fault], seed: int, load: float) -> str:
    return f"""{KILLS_BEGIN}
## Kills with the default settings

Measured on {datetime.now(UTC):%Y-%m-%d} on {os.cpu_count()} cores ({processor()}; load average before it began {load:.1f}), seed {seed}, by

    python -m benchmarks.service_faults --kills --write docs/service_faults.md

{sum(KILLS.values())} kills during a job of {FRAMES} frames, once on PostgreSQL and once on SQLite, at random moments and in random
order; the rest is as above.

{chr(10).join(table(faults))}

Every setting has its default (`max_lost` 3). A job fails that loses four workers without progress between them, because the job may be
what kills them: without a new frame, a finished step, or a stage that the step had not come to. A worker that dies before the furthest
stage of the step counts a tenth.
{KILLS_END}
"""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=random.randrange(2**32))
    parser.add_argument("--write", type=Path, help="the document that the table goes into")
    parser.add_argument("--kills", action="store_true", help="only the kills")
    parser.add_argument("--sqlite", action="store_true", help="without PostgreSQL")
    chosen = parser.parse_args(arguments)
    programs = binaries()
    if programs is None and not chosen.sqlite:
        sys.exit("no PostgreSQL server programs: neither on the PATH nor in /usr/lib/postgresql")
    print(f"seed {chosen.seed}")
    began, load = time.monotonic(), os.getloadavg()[0]
    with tempfile.TemporaryDirectory(prefix="relit-faults-") as name, ExitStack() as stack:
        folder = Path(name)
        server = None if chosen.sqlite or programs is None else stack.enter_context(postgres(programs))
        new_database: NewDatabase = (lambda: None) if server is None else server.new_database
        scene = make_scene_files(folder / "scene")
        faults = kills(folder / "kills", new_database, scene, random.Random(chosen.seed), "SQLite" if server is None else "PostgreSQL")
        if server is not None:
            faults += kills(folder / "sqlite", lambda: None, scene, random.Random(chosen.seed + 1), "SQLite")
        rows: list[tuple[str, int, Callable[[Harness, str], float | None], dict[str, float]]] = [
            ("SIGKILL of all workers at once", 3, kill_all, {}),
            ("SIGSTOP of the worker at work", 2, stop_one, {"stall_s": STALL_S}),
            ("SIGTERM to the `relit worker` at work", 3, ask_one_to_end, {})]
        if chosen.kills:
            rows = []
        elif server is not None:
            rows += [("PostgreSQL restarted (fast)", 3, restarted(server, "fast", 0.0), {}),
                     ("PostgreSQL restarted (immediate)", 3, restarted(server, "immediate", 0.0), {}),
                     ("PostgreSQL away for 10 s", 2, restarted(server, "fast", 10.0), {})]
        for number, (kind, times, disturb, settings) in enumerate(rows):
            faults.append(disturbed(folder / str(number), new_database, scene, kind, times, disturb, **settings))
    section = kills_section([fault for fault in faults if of_kills(fault)], chosen.seed, load)
    text = section if chosen.kills else document(faults, chosen.seed, time.monotonic() - began, load) + "\n" + section
    print(text)
    dead = [each for fault in faults if "SIGKILL of the worker" in fault.kind or "all workers" in fault.kind for each in fault.takeovers_s]
    assert all(fault.identical == fault.frames and fault.lost == 0 for fault in faults), "frames or jobs are lost"
    assert max(dead) < TAKEOVER_LIMIT_S, f"a takeover took {max(dead):.1f} s"
    if chosen.write is not None and not chosen.sqlite:
        before = chosen.write.read_text() if chosen.kills else ""
        chosen.write.write_text(before.partition(KILLS_BEGIN)[0].rstrip("\n") + "\n\n" + text if chosen.kills else text)


if __name__ == "__main__":
    main()
