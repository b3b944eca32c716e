"""Attacks on the API's front door, while somebody else reads: how soon these reads are answered, and how much the log grows.

    python -m benchmarks.service_attacks [--seconds S] [--half N] [--idle N] [--streams N] [--descriptors N]

Three attackers of loopback, each in a process of its own, first alone and then together: requests whose header never ends (a byte now and
then, and a new connection for each that is closed), connections that send nothing, and event streams of one key. Meanwhile a client asks
for /healthz, on a new connection each time, and another reads the jobs of another project. Prints the table of docs/service_security.md.
Numbers of connections are lowered to what the system lets this program open, and the table says so.
"""

import argparse
import asyncio
import http.client
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections import deque
from contextlib import suppress
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

import numpy as np

from benchmarks.service_process import RELIT, running

PER_SECOND = 200
"""Connections that an attacker opens in a second at most."""
AGAIN_S = 5.0
"""Seconds until an attacker opens a connection again that was closed."""
TRICKLE_S = 2.0
"""Seconds between two bytes of a header that never ends."""
ASK_S = 0.05
"""Seconds between two reads of a client."""
SPARE = 256
NICE = 15
"""Attackers have a processor of their own; here they get what the service and its readers leave."""
HALF = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX-Slow: "
HEAD = ("| attack | asked for | open in the end | reads | `/healthz` p50, p99, ms | reads of another project p50, p99, ms | not answered | "
        "connections a second | log, KiB | files open at most | processor of the API | it waited for one | "
        "its memory, MiB |\n|---|---|---|---|---|---|---|---|---|---|---|---|---|")


class Attack(NamedTuple):
    """Connections that one attacker keeps open."""

    name: str
    count: int
    sent: bytes
    trickle: bytes
    """Sent every TRICKLE_S; empty: nothing."""


def attack(port: int, wanted: Attack, ended: Event, held: "multiprocessing.Queue[tuple[int, int]]") -> None:
    """Keep connections open until the end, and tell how many there are then, and how many were opened."""
    _raise_limit()
    os.nice(NICE)
    asyncio.run(_attack(port, wanted, ended, held))


async def _attack(port: int, wanted: Attack, ended: Event, held: "multiprocessing.Queue[tuple[int, int]]") -> None:
    open_now = opened = 0

    async def one(number: int) -> None:
        nonlocal open_now, opened
        await asyncio.sleep(number / PER_SECOND)
        while not ended.is_set():
            try:
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
            except OSError:
                await asyncio.sleep(1)
                continue
            open_now += 1
            opened += 1
            with suppress(OSError, TimeoutError):
                writer.write(wanted.sent)
                while not ended.is_set():
                    with suppress(TimeoutError):
                        if not await asyncio.wait_for(reader.read(4096), TRICKLE_S):
                            break
                    if wanted.trickle:
                        writer.write(wanted.trickle)
            open_now -= not ended.is_set()
            writer.transport.abort()
            await asyncio.sleep(AGAIN_S)

    tasks = [asyncio.create_task(one(number)) for number in range(wanted.count)]
    while not ended.is_set():
        await asyncio.sleep(0.1)
    held.put((open_now, opened))
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def ask(port: int, path: str, key: str | None, seconds: float, times: "multiprocessing.Queue[list[float]]") -> None:
    """Read again and again; what is not answered in time counts as infinite."""
    found: deque[float] = deque()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        began = time.perf_counter()
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
        try:
            connection.request("GET", path, headers={} if key is None else {"Authorization": f"Bearer {key}"})
            answer = connection.getresponse()
            answer.read()
            found.append(time.perf_counter() - began if answer.status == 200 else float("inf"))
        except (OSError, http.client.HTTPException):
            found.append(float("inf"))
        finally:
            connection.close()
        time.sleep(ASK_S)
    times.put(list(found))


def row(name: str, url: str, pid: int, log: Path, other: str, attacks: list[Attack], seconds: float) -> str:
    """Attack for some seconds and measure meanwhile."""
    port, before = urlsplit(url).port or 0, log.stat().st_size
    ended, held = multiprocessing.Event(), multiprocessing.Queue()
    began, worked, delayed = time.monotonic(), processor_s(pid), delay_s(pid)
    attackers = [multiprocessing.Process(target=attack, args=(port, wanted, ended, held)) for wanted in attacks]
    for process in attackers:
        process.start()
    time.sleep(max((wanted.count for wanted in attacks), default=0) / PER_SECOND + 1)  # until all have been opened once
    results = []
    readers = []
    for path, key in (("/healthz", None), ("/v1/jobs", other)):
        results.append(multiprocessing.Queue())
        readers.append(multiprocessing.Process(target=ask, args=(port, path, key, seconds, results[-1])))
        readers[-1].start()
    most = 0
    while any(reader.is_alive() for reader in readers):
        most = max(most, len(os.listdir(f"/proc/{pid}/fd")))
        time.sleep(0.2)
        if all(not result.empty() for result in results):
            break
    found = [np.array(result.get(timeout=60)) for result in results]
    ended.set()
    told = [held.get(timeout=60) for _ in attackers]
    kept, opened = [one for one, _ in told], sum(other for _, other in told)
    spent = time.monotonic() - began
    for process in (*attackers, *readers):
        process.join(60)
    lost = sum(int(np.isinf(times).sum()) for times in found)
    spans = [", ".join(f"{1e3 * np.percentile(times, part, method='higher'):.1f}" for part in (50, 99)) for times in found]
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    busy, grown = (processor_s(pid) - worked) / spent, (log.stat().st_size - before) / 1024
    wanted_of, held_of = (" + ".join(map(str, numbers)) or 0 for numbers in ([wanted.count for wanted in attacks], kept))
    cells = (name, wanted_of, held_of, sum(map(len, found)), *spans, lost, f"{opened / spent:.0f}", f"{grown:.0f}", most,
             f"{100 * busy:.0f} %", f"{100 * (delay_s(pid) - delayed) / spent:.0f} %", f"{pages * os.sysconf('SC_PAGE_SIZE') / 2**20:.0f}")
    return f"| {' | '.join(map(str, cells))} |"


def processor_s(pid: int) -> float:
    """Seconds of processor that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def delay_s(pid: int) -> float:
    """Seconds for which the main thread of a process, that of its event loop, could run and waited for a processor."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1]) / 1e9


def key_of(data: Path, project: str) -> str:
    """Make a key that may read a project."""
    return subprocess.run([*RELIT, "keys", "create", "--project", project, "--name", "attack", "--scope", "read", "--data", str(data)],
                          check=True, capture_output=True, text=True).stdout.strip()


def rows(seconds: float, half: int, idle: int, streams: int, descriptors: int | None) -> list[str]:
    """The table."""
    room = _raise_limit() - SPARE
    half, idle, streams = (min(count, room) for count in (half, idle, streams))
    with tempfile.TemporaryDirectory() as folder, running(
            Path(folder), descriptors=descriptors, requests_per_second="50", request_burst="200", min_free_bytes="0") as service:
        ours, theirs = key_of(Path(folder) / "data", "birch"), key_of(Path(folder) / "data", "larch")
        stream = f"GET /v1/events HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {theirs}\r\n\r\n".encode()
        kinds = [Attack("headers that never end", half, HALF, b"x"), Attack("idle connections", idle, b"", b""),
                 Attack("event streams of one key", streams, stream, b"")]
        log = Path(folder) / "log.txt"
        found = [HEAD]
        for name, attacks in (("none", []), *((kind.name, [kind]) for kind in kinds), ("all three", kinds)):
            found.append(row(name, service.url, service.pid, log, ours, list(attacks), seconds))
            print(found[-1], file=sys.stderr, flush=True)
            time.sleep(2)
        return found


def _raise_limit() -> int:
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    return hard


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20, help="of each attack")
    parser.add_argument("--half", type=int, default=2000, help="requests whose header never ends")
    parser.add_argument("--idle", type=int, default=5000, help="idle connections")
    parser.add_argument("--streams", type=int, default=2000, help="event streams of one key")
    parser.add_argument("--descriptors", type=int, help="files that the service may have open; without it what the system allows")
    given = parser.parse_args()
    print("\n".join(rows(given.seconds, given.half, given.idle, given.streams, given.descriptors)))
