"""The service under load: clients that poll a job and stream its events while it runs, others that upload.

How soon it answers, what it fails, and what its API process holds.

    python -m benchmarks.service_load [--minutes N] [--clients N] [--interval SECONDS] [--uploads N] [--cores N]

Everything shares the same cores: the service, its worker that relights on all of them, and the clients.
"""

import argparse
import http.client
import json
import os
import shutil
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import numpy as np

from benchmarks.service_process import SAMPLES, Running, running
from service.client import Client, ClientError
from service.requests.jobs import RelightJob
from service.requests.relight import RelightOptions

OWL, SKY = SAMPLES / "owl", SAMPLES / "owl" / "environment.exr"
FRAMES = 400
"""Frames of one job, which then runs for several seconds."""
WAITING = 3
"""Jobs that are kept in the queue, so that the worker is never idle."""
ENDED = ("succeeded", "failed", "cancelled")
SETTLE_S = 60.0
"""Memory is compared from here on: pools, caches and allocator have grown to what the load needs."""
SAMPLE_S = 2.0
TIMEOUT_S = 60.0
HEAD = ("| clients | cores | minutes | reads | p50, ms | p99, ms | worst, ms | events | jobs | files uploaded | errors | "
        "memory after settling, MiB | after half the time | at the end | growth, MiB/min |\n"
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|---|")


class Load:
    """What all clients share."""

    def __init__(self, service: Running, interval_s: float) -> None:
        self.service, self.interval_s = service, interval_s
        self.ended = threading.Event()
        self.reads: list[float] = []  # seconds
        self.counts: Counter[str] = Counter()
        self.errors: Counter[str] = Counter()
        self.current = ""
        self._address = urlsplit(service.url)

    def connect(self) -> http.client.HTTPConnection:
        """The plainest client that there is, so that the load costs little itself."""
        return http.client.HTTPConnection(self._address.hostname or "", self._address.port, timeout=TIMEOUT_S)

    def get(self, connection: http.client.HTTPConnection, path: str) -> http.client.HTTPResponse:
        """An answer whose body is still to be read."""
        connection.request("GET", path, headers={"Authorization": f"Bearer {self.service.key}"})
        return connection.getresponse()

    def fail(self, what: str) -> None:
        """Count an error, unless it is the end."""
        if not self.ended.is_set():
            self.errors[what] += 1

    def poll(self, number: int, clients: int) -> None:
        """Read the state of the job that runs, every interval."""
        connection = self.connect()
        self.ended.wait(self.interval_s * number / clients)  # not all at once
        while not self.ended.is_set():
            began = time.perf_counter()
            try:
                answer = self.get(connection, f"/v1/jobs/{self.current}")
                body = answer.read()
                self.reads.append(time.perf_counter() - began)
                if answer.status != 200 or json.loads(body)["state"] not in ("queued", "running", *ENDED):
                    self.fail(f"read: status {answer.status}")
            except (OSError, http.client.HTTPException, ValueError) as error:
                self.fail(f"read: {error!r}")
                connection.close()
            self.ended.wait(max(0.0, self.interval_s - (time.perf_counter() - began)))

    def listen(self, number: int, clients: int) -> None:
        """Stream the events of the job that runs until it has ended; then, within a second, of the next.

        Clients of one's own do not come in the same instant: a read among them would wait for all that came before it.
        """
        while not self.ended.wait(self.interval_s * number / clients):
            job, connection, last = self.current, self.connect(), None
            try:
                answer = self.get(connection, f"/v1/jobs/{job}/events")
                if answer.status != 200:
                    self.fail(f"events: status {answer.status}")
                for line in answer:
                    if line.startswith(b"data:"):
                        last = json.loads(line[5:])["state"]
                        self.counts["events"] += 1
                    if self.ended.is_set():
                        return
                if last not in ENDED:
                    self.fail("events: a stream ended before its job")
            except (OSError, http.client.HTTPException, ValueError) as error:
                self.fail(f"events: {error!r}")
            finally:
                connection.close()
            while self.current == job and not self.ended.wait(0.05):
                pass

    def work(self, client: Client, capture: str, environment: str) -> None:
        """Keep jobs waiting; the oldest of them is the one that everybody looks at."""
        request = RelightJob(kind="relight", capture=capture, environment=environment,
                             options=RelightOptions(frames=f"1-{FRAMES}", spin_degrees=360))
        jobs = [client.jobs.submit(request).id]
        self.current = jobs[0]
        while not self.ended.is_set():
            while len(jobs) <= WAITING:
                jobs.append(client.jobs.submit(request).id)
            state = client.jobs.get(jobs[0]).state
            if state in ENDED:
                if state != "succeeded":
                    self.fail(f"job: {state}")
                self.counts["jobs"] += 1
                self.current = jobs[1]
                done = jobs.pop(0)
                self.ended.wait(1.0)  # those who listen have read its end
                client.jobs.delete(done)
            self.ended.wait(0.2)
        for job in jobs:
            client.jobs.cancel(job)

    def upload(self, folder: Path, number: int) -> None:
        """Upload a capture that is new each time, wait for its check, and delete it."""
        copy = folder / f"capture-{number}"
        shutil.copytree(OWL, copy, ignore=shutil.ignore_patterns(".*"))
        turn = 0
        with Client(self.service.url, self.service.key, parallel=1) as client:
            while not self.ended.is_set():
                (copy / "note.txt").write_text(f"{number} {(turn := turn + 1)}")
                try:
                    client.captures.delete(client.captures.upload(copy, name=f"load {number}").id)
                    self.counts["files"] += len(list(copy.iterdir()))
                except ClientError as error:
                    self.fail(f"upload: {error}")


class Memory(NamedTuple):
    """Resident memory of the API process, MiB."""

    settled: float
    half: float
    last: float
    per_minute: float
    """Slope of a line through what was seen since it settled."""
    by_minute: list[float]
    """Medians of each minute from the first."""


def watch_memory(pid: int, seconds: float) -> Memory:
    """Sample for a time."""
    seen = []
    began = time.perf_counter()
    while (now := time.perf_counter() - began) < seconds:
        seen.append((now, _resident(pid)))
        time.sleep(SAMPLE_S)
    late = np.array([one for one in seen if one[0] >= min(SETTLE_S, seconds / 4)])
    tenth = max(1, len(late) // 10)
    slope = np.polyfit(late[:, 0] / 60, late[:, 1], 1)[0]
    half = late[late[:, 0] >= seconds / 2]
    by_minute = [float(np.median([size for at, size in seen if at // 60 == minute])) for minute in range(int(seconds // 60))]
    return Memory(*(float(np.median(part[:, 1])) for part in (late[:tenth], half[:tenth], late[-tenth:])), float(slope), by_minute)


def _resident(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def load_rows(minutes: float, clients: int, interval_s: float, uploads: int, cores: int, **settings: Any) -> list[str]:
    """A table with one row, and below it the errors, if there are any."""
    os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:cores]))  # of the service too, which is our child
    with tempfile.TemporaryDirectory() as name, running(Path(name) / "service", **settings) as service, \
            Client(service.url, service.key) as client:
        capture, environment = client.captures.register(str(OWL)).id, client.environments.register(str(SKY)).id
        load = Load(service, interval_s)
        threads = [threading.Thread(target=load.work, args=(client, capture, environment))]
        threads[0].start()
        while not load.current:
            time.sleep(0.01)
        threads += [threading.Thread(target=load.poll, args=(number, clients)) for number in range(clients)]
        threads += [threading.Thread(target=load.listen, args=(number, clients)) for number in range(clients)]
        threads += [threading.Thread(target=load.upload, args=(Path(name), number)) for number in range(uploads)]
        for thread in threads[1:]:
            thread.start()
        memory = watch_memory(service.pid, 60 * minutes)
        load.ended.set()
        for thread in threads:
            thread.join()
    reads = 1e3 * np.array(load.reads)
    counts = load.counts
    return [HEAD, f"| {clients} | {cores} | {minutes:g} | {len(reads)} | {np.percentile(reads, 50):.1f} | {np.percentile(reads, 99):.1f} | "
                  f"{reads.max():.0f} | {counts['events']} | {counts['jobs']} of {FRAMES} frames | {counts['files']} | "
                  f"{sum(load.errors.values())} | {memory.settled:.1f} | {memory.half:.1f} | {memory.last:.1f} | "
                  f"{memory.per_minute:+.2f} |",
            f"\nMemory in each minute, medians, MiB: {', '.join(f'{size:.1f}' for size in memory.by_minute)}",
            *(f"\n{count} × {error}" for error, count in load.errors.items())]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--clients", type=int, default=64)
    parser.add_argument("--interval", type=float, default=1.0, help="seconds between two reads of a client")
    parser.add_argument("--uploads", type=int, default=1, help="clients that upload captures all the time")
    parser.add_argument("--cores", type=int, default=2)
    given = parser.parse_args()
    rows = load_rows(given.minutes, given.clients, given.interval, given.uploads, given.cores)
    print("\n".join(rows))
    sys.exit(1 if len(rows) > 2 else 0)
