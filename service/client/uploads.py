"""Uploads that can be resumed: the client's side of tus 1.0 (https://tus.io/protocols/resumable-upload)."""

import threading
from base64 import b64encode
from collections.abc import Iterator
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait

import httpx2

from service.client.errors import FileError, refusal
from service.client.files import PIECE, LocalFile, reading
from service.client.link import LATER, PROXY, Link, retry_after
from service.client.tally import Tally

TUS = {"Tus-Resumable": "1.0.0"}
ELSEWHERE = (409, 423)
"""Statuses with which the offset is another than was thought, or a request before is still being written."""


class _Ended(Exception):
    """Another file of the same upload failed."""


def send_files(link: Link, intake: str, files: list[LocalFile], *, parallel: int, tally: Tally) -> None:
    """Upload the files of a capture or environment, several at once; what is there already is not sent again.

    Args:
        link: to the service.
        intake: path of the capture or environment.
        files: to send.
        parallel: files at once.
        tally: told of every byte.

    Raises:
        ClientError: one file could not be sent; the others have been stopped, and can be gone on with.
    """
    ended = threading.Event()
    pool = ThreadPoolExecutor(parallel)
    try:
        futures = [pool.submit(_send, link, intake, file, tally, ended) for file in files]
        done, _ = wait(futures, return_when=FIRST_EXCEPTION)
        for future in done:
            future.result()
    finally:  # also where Ctrl-C comes
        ended.set()
        pool.shutdown(cancel_futures=True)


def _send(link: Link, intake: str, file: LocalFile, tally: Tally, ended: threading.Event) -> None:
    if ended.is_set():
        return
    upload = _create(link, intake, file)
    patience, sent = link.patience(), 0
    while True:
        offset = int(link.send("HEAD", upload, headers=TUS).headers["upload-offset"])
        tally.add(offset - sent)
        if offset > sent:
            patience.refresh()
        sent = offset
        if sent == file.size:
            return
        try:
            answer = link.once("PATCH", upload, content=_pieces(file, sent, ended), headers={
                **TUS, "Upload-Offset": str(sent), "Content-Type": "application/offset+octet-stream", "Content-Length": str(file.size - sent)})
        except _Ended:
            return
        except httpx2.TransportError as error:
            if not patience.wait():
                raise link.unreachable(error) from error
            continue
        if answer.status_code in (*ELSEWHERE, *LATER, *PROXY) and patience.wait(retry_after(answer)):
            continue
        if not answer.is_success:
            raise refusal(answer.status_code, answer.headers.get("content-type", ""), answer.content)
        if int(answer.headers["upload-offset"]) == file.size:
            tally.add(file.size - sent)
            return


def _create(link: Link, intake: str, file: LocalFile) -> str:
    words = {"path": file.name, "sha256": file.sha256}
    metadata = ",".join(f"{name} {b64encode(word.encode()).decode()}" for name, word in words.items())
    answer = link.send("POST", f"{intake}/files", headers={
        **TUS, "Upload-Length": str(file.size), "Upload-Metadata": metadata, "Idempotency-Key": f"{intake}/{file.sha256}/{file.name}"})
    return httpx2.URL(answer.headers["location"]).path


def _pieces(file: LocalFile, offset: int, ended: threading.Event) -> Iterator[bytes]:
    with reading(file.path), open(file.path, "rb", buffering=0) as opened:
        opened.seek(offset)
        left = file.size - offset
        while left > 0:
            if ended.is_set():
                raise _Ended
            piece = opened.read(min(PIECE, left))
            if not piece:
                raise FileError(f"{file.path}: became shorter while it was sent")
            left -= len(piece)
            yield piece
