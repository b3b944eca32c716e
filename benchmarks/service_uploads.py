"""How fast files come in: an upload over loopback against a plain copy of the same bytes, both until they are on the disk.

`python -m benchmarks.service_uploads [MiB]` prints the table of docs/figures.md. The client sends from the page cache by sendfile, and its
checksums are made beforehand, so that what is measured is the service. Copy and uploads take turns; medians.
"""

import hashlib
import os
import re
import shutil
import socket
import statistics
import sys
import tempfile
import time
from base64 import b64encode
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

import httpx2

from tests.service.server_process import Server, serving

ROUNDS = 5
MIB = 1 << 20


class Way(NamedTuple):
    """How a file is sent."""

    title: str
    piece_mib: int | None
    """Bytes that one request sends; None: one request sends the whole file."""
    algorithm: str | None = None
    """Algorithm of the checksum that each request carries."""
    whole: bool = False
    """Whether the SHA-256 of the whole file is told, and compared at its end."""


WAYS = (
    Way("one request, SHA-256 of the file (as `relit submit` does)", None, whole=True),
    Way("one request, no checksum", None),
    Way("64 MiB a request, no checksum", 64),
    Way("64 MiB a request, SHA-1 of each", 64, "sha1"),
    Way("64 MiB a request, SHA-256 of each", 64, "sha256"),
    Way("8 MiB a request, SHA-256 of each", 8, "sha256"),
)


def copy(source: Path, target: Path, *, checked: bool) -> float:
    """Seconds of a plain copy, or of one whose source is hashed first, as an upload with a checksum is."""
    began = time.perf_counter()
    if checked:
        with open(source, "rb") as file:
            hashlib.file_digest(file, "sha256")
    shutil.copyfile(source, target)
    with open(target, "rb") as file:
        os.fsync(file.fileno())
    seconds = time.perf_counter() - began
    target.unlink()
    return seconds


def upload(server: Server, client: httpx2.Client, source: Path, piece: int, checksums: list[str] | None, whole: str | None) -> float:
    """Seconds from the creation of the upload until the file is in the capture."""
    capture = client.post("/v1/captures", json={"name": "benchmark"}).raise_for_status().json()["id"]
    size = source.stat().st_size
    words = {"path": "file.bin", **({} if whole is None else {"sha256": whole})}
    metadata = ",".join(f"{name} {b64encode(word.encode()).decode()}" for name, word in words.items())
    began = time.perf_counter()
    made = client.post(f"/v1/captures/{capture}/files", headers={"Tus-Resumable": "1.0.0", "Upload-Length": str(size),
                                                                 "Upload-Metadata": metadata}).raise_for_status()
    parts = urlsplit(server.url)
    with socket.create_connection((parts.hostname, parts.port)) as connection, open(source, "rb") as file:
        for number, offset in enumerate(range(0, size, piece)):
            count = min(piece, size - offset)
            lines = [f"PATCH {made.headers['location']} HTTP/1.1", f"Host: {parts.netloc}", "Tus-Resumable: 1.0.0",
                     f"Upload-Offset: {offset}", "Content-Type: application/offset+octet-stream", f"Content-Length: {count}"]
            if checksums is not None:
                lines.append(f"Upload-Checksum: {checksums[number]}")
            connection.sendall("\r\n".join([*lines, "", ""]).encode())
            connection.sendfile(file, offset, count)
            answer = connection.recv(65536)
            assert answer.startswith(b"HTTP/1.1 204"), answer
    seconds = time.perf_counter() - began
    client.delete(f"/v1/captures/{capture}").raise_for_status()
    return seconds


def checksums(source: Path, piece: int, algorithm: str) -> list[str]:
    """Upload-Checksum of every piece."""
    with open(source, "rb") as file:
        digests = [hashlib.new(algorithm, block).digest() for block in iter(lambda: file.read(piece), b"")]
    return [f"{algorithm} {b64encode(digest).decode()}" for digest in digests]


def main(size_mib: int = 1024) -> None:
    with tempfile.TemporaryDirectory() as folder, serving(
            Path(folder), "--anonymous", "--device", "none", requests_per_second="100000", request_burst="100000",
            min_free_bytes="0") as server, server.client() as client:
        source = Path(folder) / "source.bin"
        with open(source, "wb") as file:
            for _ in range(size_mib):
                file.write(os.urandom(MIB))
        with open(source, "rb") as file:
            whole = hashlib.file_digest(file, "sha256").hexdigest()
        told = [None if way.algorithm is None else checksums(source, (way.piece_mib or size_mib) * MIB, way.algorithm) for way in WAYS]
        copies: dict[bool, list[float]] = {False: [], True: []}
        taken: list[list[float]] = [[] for _ in WAYS]
        for _ in range(ROUNDS):
            for checked, times in copies.items():
                times.append(copy(source, Path(folder) / "copy.bin", checked=checked))
            for way, sums, times in zip(WAYS, told, taken, strict=True):
                piece = (way.piece_mib or size_mib) * MIB
                times.append(upload(server, client, source, piece, sums, whole if way.whole else None))
        peak = re.search(r"VmHWM:\s+(\d+)", Path(f"/proc/{server.process.pid}/status").read_text())
    plain, hashed = (statistics.median(times) for times in copies.values())
    print(f"{size_mib} MiB over loopback, medians of {ROUNDS} rounds; {os.cpu_count()} cores for client and service"
          + (f"; peak memory of the API {int(peak[1]) >> 10} MiB" if peak else "") + "\n")
    print("| | MiB/s | of a plain copy | of a copy with SHA-256 |\n|---|---|---|---|")
    for title, seconds in (("copy and fsync", plain), ("SHA-256, copy and fsync", hashed)):
        print(f"| {title} | {size_mib / seconds:.0f} | {100 * plain / seconds:.0f} % | {100 * hashed / seconds:.0f} % |")
    for way, times in zip(WAYS, taken, strict=True):
        seconds = statistics.median(times)
        print(f"| upload: {way.title} | {size_mib / seconds:.0f} | {100 * plain / seconds:.0f} % | {100 * hashed / seconds:.0f} % |")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
