"""Processes that decode images of captures for a worker: a file that damages the memory of its decoder damages nothing else.

A process is given an open file over a socket, and answers with the header, or with the pixels in memory that both processes map. It has no
settings of the service, and limits of memory and processor time. The processes start when they are needed, and end with the step.
"""

import fcntl
import json
import mmap
import os
import resource
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from service.captures.check_process import bare_environment, limit
from stage import inputs
from stage.errors import ImageError, StageError
from stage.formats import images
from stage.formats.exif import Exposure
from stage.formats.images import ImageHeader

BASE_BYTES, PIXEL_BYTES = 2 << 30, 24
"""Bytes of data that a process may have, besides so many for each pixel that an image may have."""
CPU_S, WALL_S = 120, 600.0
"""Seconds of processor time, and seconds, that one image may take."""
MOST_PROCESSES, HEADER_PROCESSES = 8, 2
"""Processes that decode at one time, and of these that read headers: a header takes less than a thousandth of the start of a process."""
MESSAGE_BYTES = 1 << 16
COMMAND = (sys.executable, "-P", "-m", __name__)
SHRINK = 2
"""F_SEAL_SHRINK of fcntl(2): the memory cannot become shorter while it is mapped here."""


class _Process:
    def __init__(self, max_pixels: int) -> None:
        self.socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self.process = subprocess.Popen([*COMMAND, str(theirs.fileno()), str(max_pixels)], env=bare_environment(), cwd=os.sep,
                                            pass_fds=[theirs.fileno()], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                                            stderr=subprocess.DEVNULL, start_new_session=True)
        self.socket.settimeout(WALL_S)

    def ask(self, what: str, source: inputs.Source) -> tuple[dict[str, Any], list[int]]:
        """Return the answer, and descriptors that came with it; an OSError says that the process ended, or takes too long."""
        socket.send_fds(self.socket, [json.dumps({"what": what, "path": str(source.path)}).encode()], [source.file.fileno()])
        data, descriptors, _, _ = socket.recv_fds(self.socket, MESSAGE_BYTES, 1)
        if not data:
            raise ConnectionResetError
        return json.loads(data), descriptors

    def end(self) -> int:
        """End the process, and return its exit code."""
        self.socket.close()
        try:
            return self.process.wait(1.0)  # one that crashed tells how
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()


class Decoders:
    """Decodes images in other processes, several at one time. Implements `stage.formats.images.Decoder`."""

    def __init__(self, max_pixels: int) -> None:
        self._max_pixels = max_pixels
        self._places = threading.BoundedSemaphore(min(os.cpu_count() or 1, MOST_PROCESSES))
        self._headers = threading.BoundedSemaphore(HEADER_PROCESSES)
        self._idle: list[_Process] = []
        self._lock = threading.Lock()

    def header(self, path: Path) -> ImageHeader:
        """Return the header of an image; errors are those of `stage.formats.images.read_header`."""
        with self._headers:
            answer, _ = self._ask("header", path)
        header = ImageHeader(*answer["header"])
        return header._replace(exposure=Exposure(*header.exposure))

    def recorded(self, path: Path) -> np.ndarray:
        """Return the pixels of an image; errors are those of `stage.formats.images.read_recorded`."""
        answer, descriptors = self._ask("recorded", path)
        shape, kind = tuple(answer["shape"]), np.dtype(answer["kind"])
        count = int(np.prod(shape)) * kind.itemsize
        try:
            fcntl.fcntl(descriptors[0], fcntl.F_ADD_SEALS, SHRINK)
            if len(shape) != 3 or kind.kind not in "uf" or not 0 < count <= os.fstat(descriptors[0]).st_size:
                raise ImageError(f"{path}: cannot be decoded: its data is damaged")
            memory = mmap.mmap(descriptors[0], count, flags=mmap.MAP_PRIVATE, prot=mmap.PROT_READ | mmap.PROT_WRITE)
        finally:
            for descriptor in descriptors:
                os.close(descriptor)
        return np.frombuffer(memory, kind).reshape(shape)

    def close(self) -> None:
        """End the processes."""
        for process in self._idle:
            process.process.kill()
            process.end()
        self._idle.clear()

    def _ask(self, what: str, path: Path) -> tuple[dict[str, Any], list[int]]:
        with inputs.opened(path) as source, self._process() as process:
            try:
                answer, descriptors = process.ask(what, source)
            except (OSError, ValueError) as error:
                hangs = isinstance(error, TimeoutError)
                if hangs:
                    process.process.kill()
                why = f"it takes longer than {WALL_S:g} seconds" if hangs else f"its decoder broke off (exit code {process.end()})"
                raise ImageError(f"{path}: cannot be decoded: {why}") from error
        if "error" in answer:
            raise ImageError(str(answer["error"]))
        return answer, descriptors

    @contextmanager
    def _process(self) -> Iterator[_Process]:
        """Lend an idle process, or a new one; one that ended is not lent again."""
        with self._places:
            with self._lock:
                process = self._idle.pop() if self._idle else None
            process = process or _Process(self._max_pixels)
            try:
                yield process
            except BaseException:
                process.process.kill()
                process.end()
                raise
            with self._lock:
                self._idle.append(process)


def main(descriptor: int, max_pixels: int) -> None:
    """Decode the images that come over the socket, until it is closed."""
    limit(DATA=BASE_BYTES + PIXEL_BYTES * max_pixels)
    with socket.socket(fileno=descriptor) as asking:
        while True:
            data, descriptors, _, _ = socket.recv_fds(asking, MESSAGE_BYTES, 1)
            if not data:
                return
            asked = json.loads(data)
            spent = resource.getrusage(resource.RUSAGE_SELF)
            _, hard = resource.getrlimit(resource.RLIMIT_CPU)
            resource.setrlimit(resource.RLIMIT_CPU, (int(spent.ru_utime + spent.ru_stime) + CPU_S, hard))
            with os.fdopen(descriptors[0], "rb") as file:
                source = inputs.Source(Path(asked["path"]), file, True, max_pixels)
                try:
                    _answer(asking, asked["what"], source)
                except StageError as error:
                    text = str(error)
                except MemoryError:
                    text = f"{source.path}: cannot be decoded: it takes more memory than an image may"
                else:
                    continue
            socket.send_fds(asking, [json.dumps({"error": text[: MESSAGE_BYTES // 8]}).encode()], [])


def _answer(asking: socket.socket, what: str, source: inputs.Source) -> None:
    if what == "header":
        socket.send_fds(asking, [json.dumps({"header": list(images.header_of(source))}).encode()], [])
        return
    pixels = np.ascontiguousarray(images.recorded_of(source))
    memory = os.memfd_create("pixels", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(memory, pixels.nbytes)
        with mmap.mmap(memory, pixels.nbytes) as mapped:
            mapped[:] = pixels.data.cast("B")
        socket.send_fds(asking, [json.dumps({"shape": pixels.shape, "kind": pixels.dtype.str}).encode()], [memory])
    finally:
        os.close(memory)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
