"""What a job has made, fetched: gone on with where it broke off, and under its name only when it is whole."""

import hashlib
import os
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from glob import escape
from pathlib import Path, PurePosixPath
from threading import Event
from urllib.parse import quote

import httpx2

from service.client.errors import FileError, refusal
from service.client.files import PIECE, reading
from service.client.link import LATER, PROXY, Link, retry_after
from service.client.tally import Tally

PARTIAL = 206
PLAIN = {"Accept-Encoding": "identity"}
"""So that bytes are counted as the file has them."""


def fetch(link: Link, results: str, names: list[str], folder: Path, *, parallel: int, tally: Tally) -> list[Path]:
    """Fetch files, several at once.

    Args:
        link: to the service.
        results: path of the job's results.
        names: of the files.
        folder: for them; made where there is none.
        parallel: files at once.
        tally: told of every byte.

    Returns:
        Where they are, in the order given.

    Raises:
        ClientError: one could not be fetched; the others have been stopped, and are gone on with by the next call.
    """
    ended = Event()
    pool = ThreadPoolExecutor(parallel)
    try:
        futures = [pool.submit(_Fetch(link, results, name, folder, tally, ended).run) for name in names]
        done, _ = wait(futures, return_when=FIRST_EXCEPTION)
        for future in done:
            future.result()
        return [future.result() for future in futures]
    finally:  # also where Ctrl-C comes
        ended.set()
        pool.shutdown(cancel_futures=True)


class _Ended(Exception):
    """Another file failed."""


class _Fetch:
    """One file on its way: a part beside its place, named after its ETag, so that what is left of another version is not gone on with."""

    def __init__(self, link: Link, results: str, name: str, folder: Path, tally: Tally, ended: Event) -> None:
        self._link, self._name, self._tally, self._ended = link, name, tally, ended
        self._url, self._target = f"{results}/{quote(name)}", folder / _safe(name)
        self._etag, self._size, self._got = "", -1, 0

    def run(self) -> Path:
        """Fetch what is not here yet, until all is."""
        with reading(self._target.parent, "make"):
            self._target.parent.mkdir(parents=True, exist_ok=True)
        if self._parts():
            self._note(self._link.send("HEAD", self._url, headers=PLAIN))
        patience = self._link.patience()
        while self._got != self._size:
            before = self._got
            try:
                later = self._fetch()
            except httpx2.TransportError as error:
                if self._got <= before and not patience.wait():
                    raise self._link.unreachable(error) from error
            else:
                if later is not None and not patience.wait(retry_after(later)):
                    raise refusal(later.status_code, later.headers.get("content-type", ""), later.content)
            if self._got > before:
                patience.refresh()
        with reading(self._target, "write"):
            os.replace(self._part, self._target)
            for left in self._parts():
                left.unlink()
        return self._target

    def _fetch(self) -> httpx2.Response | None:
        """Add to the part what comes; the answer, where it says that the file can be had later."""
        if self._ended.is_set():
            raise _Ended
        headers = PLAIN | ({"Range": f"bytes={self._got}-", "If-Range": self._etag} if self._got else {})
        with self._link.http.stream("GET", self._url, headers=headers) as answer:
            if answer.status_code in (*LATER, *PROXY):
                answer.read()
                return answer
            if not answer.is_success:
                raise refusal(answer.status_code, answer.headers.get("content-type", ""), answer.read())
            if answer.status_code != PARTIAL:  # from its beginning, and perhaps another one than before
                self._note(answer)
                self._tell(0)
            with reading(self._part, "write"), open(self._part, "ab" if self._got else "wb", buffering=PIECE) as part:
                for piece in answer.iter_raw():
                    if self._ended.is_set():
                        raise _Ended
                    part.write(piece)
                    self._tell(self._got + len(piece))
        return None

    def _note(self, answer: httpx2.Response) -> None:
        """Which version there is, and how much of it is here."""
        self._etag, self._size = answer.headers["etag"], int(answer.headers["content-length"])
        there = self._part.stat().st_size if self._part.exists() else 0
        self._tell(there if there <= self._size else 0)

    @property
    def _part(self) -> Path:
        version = hashlib.sha256(self._etag.encode()).hexdigest()[:16]
        return self._target.with_name(f".{self._target.name}.{version}.part")

    def _parts(self) -> list[Path]:
        return list(self._target.parent.glob(f".{escape(self._target.name)}.{'?' * 16}.part"))

    def _tell(self, got: int) -> None:
        self._tally.add(got - self._got)
        self._got = got


def _safe(name: str) -> PurePosixPath:
    """A name from the service as a path below a folder of ours."""
    path = PurePosixPath(name)
    if path.is_absolute() or not path.parts or ".." in path.parts or "\\" in name or "\0" in name or ":" in name:
        raise FileError(f"{name!r}: the service names a file that cannot be written here")
    return path
