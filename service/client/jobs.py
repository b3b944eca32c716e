"""Jobs: submitted, followed by server-sent events, controlled, and their results downloaded; and hooks, which are told their ends."""

import hashlib
import os
import secrets
import time
from collections.abc import Iterator, Sequence
from glob import escape
from pathlib import Path, PurePosixPath
from threading import Event
from urllib.parse import quote

import httpx2

from service.client.connection import LATER, PROXY, Connection, retry_after
from service.client.errors import FileError, JobEnded, refusal
from service.client.local_files import file_errors
from service.client.transfer import PIECE_BYTES, Stopped, TransferProgress, transfer_all
from service.reporting.progress import Progress
from service.requests.answers import DeliveryView, HookList, HookView, JobLog, JobPage, JobView, NewHookView, ResultPage, ResultView
from service.requests.base.base import JobRequest
from service.requests.hooks import NewHook
from service.requests.states import ENDED, SUCCEEDED, JobState

PARTIAL = 206
PLAIN = {"Accept-Encoding": "identity"}
"""Ask for the bytes of the file without compression, so that ranges count them."""


class Download:
    """The download of one file: into a hidden file named after its ETag, so that parts of two versions are never mixed."""

    def __init__(self, connection: Connection, results: str, name: str, folder: Path, progress: TransferProgress) -> None:
        self._connection, self._name, self._progress = connection, name, progress
        self._url, self._target = f"{results}/{quote(name)}", folder / _safe(name)
        self._etag, self._size, self._got = "", -1, 0

    def run(self, stop: Event) -> Path:
        """Fetch the bytes that are missing, until the file is complete or `stop` is set."""
        with file_errors(self._target.parent, "make"):
            self._target.parent.mkdir(parents=True, exist_ok=True)
        if self._parts():
            self._note(self._connection.send("HEAD", self._url, headers=PLAIN))
        backoff = self._connection.backoff()
        while self._got != self._size:
            before = self._got
            try:
                later = self._fetch(stop)
            except httpx2.TransportError as error:
                if self._got <= before and not backoff.wait():
                    raise self._connection.unreachable(error) from error
            else:
                if later is not None and not backoff.wait(retry_after(later)):
                    raise refusal(later)
            if self._got > before:
                backoff.reset()
        with file_errors(self._target, "write"):
            os.replace(self._part, self._target)
            for left in self._parts():
                left.unlink()
        return self._target

    def _fetch(self, stop: Event) -> httpx2.Response | None:
        """Append the bytes of one answer to the part; return the answer instead if it asks to come back later."""
        if stop.is_set():
            raise Stopped
        headers = PLAIN | ({"Range": f"bytes={self._got}-", "If-Range": self._etag} if self._got else {})
        with self._connection.http.stream("GET", self._url, headers=headers) as answer:
            if answer.status_code in (*LATER, *PROXY):
                answer.read()
                return answer
            if not answer.is_success:
                raise refusal(answer)
            if answer.status_code != PARTIAL:  # the whole file, and perhaps another version than before
                self._note(answer)
                self._report(0)
            with file_errors(self._part, "write"), open(self._part, "ab" if self._got else "wb", buffering=PIECE_BYTES) as part:
                for piece in answer.iter_raw():
                    if stop.is_set():
                        raise Stopped
                    part.write(piece)
                    self._report(self._got + len(piece))
        return None

    def _note(self, answer: httpx2.Response) -> None:
        """Take the version and size of the file from an answer, and see how many bytes of that version are on disk."""
        self._etag, self._size = answer.headers["etag"], int(answer.headers["content-length"])
        there = self._part.stat().st_size if self._part.exists() else 0
        self._report(there if there <= self._size else 0)

    @property
    def _part(self) -> Path:
        version = hashlib.sha256(self._etag.encode()).hexdigest()[:16]
        return self._target.with_name(f".{self._target.name}.{version}.part")

    def _parts(self) -> list[Path]:
        return list(self._target.parent.glob(f".{escape(self._target.name)}.{'?' * 16}.part"))

    def _report(self, got: int) -> None:
        self._progress.add(got - self._got)
        self._got = got


def _safe(name: str) -> PurePosixPath:
    path = PurePosixPath(name)
    if path.is_absolute() or not path.parts or ".." in path.parts or "\\" in name or "\0" in name or ":" in name:
        raise FileError(f"{name!r}: the service names a file that cannot be written here")
    return path


PATH = "/v1/jobs"
EVENT = "job"
SILENCE_S = 45.0
"""A stream without a byte for this long is given up: the service sends at least a comment every 15 s."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.2, 2.0
"""Seconds between two plain requests, while events bring nothing."""


class Jobs:
    """The jobs of a project."""

    def __init__(self, connection: Connection, *, parallel: int) -> None:
        self._connection, self._parallel = connection, parallel

    def submit(self, request: JobRequest, *, token: str | None = None) -> JobView:
        """Submit a job: a SolveJob, RelightJob … of service.requests.jobs.

        The same request with the same token (Idempotency-Key) returns the same job; None: a new job.
        """
        return self._connection.ask(JobView, "POST", PATH, json=request.model_dump(mode="json", by_alias=True, exclude_defaults=True),
                                    headers={"Idempotency-Key": token or secrets.token_hex(16)})

    def get(self, job: str) -> JobView:
        """Return one job."""
        return self._connection.ask(JobView, "GET", self._at(job))

    def log(self, job: str) -> JobLog:
        """Return what happened to a job, and the warnings about what it has made."""
        return self._connection.ask(JobLog, "GET", f"{self._at(job)}/log")

    def all(self, states: Sequence[JobState] = ()) -> Iterator[JobView]:
        """Iterate over the jobs of the project, the newest first; if `states` are given, over the jobs in one of them."""
        for page in self._connection.pages(JobPage, PATH, "before", state=list(states)):
            yield from page.jobs

    def follow(self, job: str) -> Iterator[JobView]:
        """Yield the job now, and again after every change, until it has ended."""
        last: JobView | None = None
        pause = FIRST_PAUSE_S
        while True:
            before = last
            try:
                for view in self._stream(job, last):
                    if last is None or view.revision > last.revision:
                        last = view
                        yield view
                        if view.state in ENDED:
                            return
            except httpx2.TransportError:
                pass
            if last is not before:
                pause = FIRST_PAUSE_S
                continue
            view = self.get(job)  # its error also says why there are no events
            if last is None or view.revision > last.revision:
                last = view
                yield view
            if view.state in ENDED:
                return
            time.sleep(pause)
            pause = min(2 * pause, LONGEST_PAUSE_S)

    def _stream(self, job: str, last: JobView | None) -> Iterator[JobView]:
        """Yield the views of one stream of events after `last`; nothing if the service refuses the stream."""
        headers = {} if last is None else {"Last-Event-ID": str(last.revision)}
        with self._connection.http.sse(f"{self._at(job)}/events", headers=headers, timeout=SILENCE_S) as events:
            if events.response.is_success:
                for event in events:
                    if event.event == EVENT:
                        yield JobView.model_validate_json(event.data)

    def wait(self, job: str, *, progress: Progress | None = None) -> JobView:
        """Wait until a job has succeeded, and tell `progress` of its stages; raise JobEnded if it failed or was cancelled."""
        stage, ended = None, None
        for ended in self.follow(job):
            if progress is not None and ended.progress is not None:
                if (ended.progress.stage, ended.progress.total) != stage:
                    stage = ended.progress.stage, ended.progress.total
                    progress.stage(*stage)
                progress.advance(ended.progress.done)
        assert ended is not None, "follow yields at least one view"
        if ended.state != SUCCEEDED:
            raise JobEnded(ended)
        return ended

    def cancel(self, job: str) -> JobView:
        """Stop a job; files that it has made stay."""
        return self._act(job, "cancel")

    def retry(self, job: str) -> JobView:
        """Begin a failed job again; steps and frames that are done stay."""
        return self._act(job, "retry")

    def resume(self, job: str) -> JobView:
        """Continue a cancelled job; steps and frames that are done stay."""
        return self._act(job, "resume")

    def prioritise(self, job: str, priority: int) -> JobView:
        """Change the priority of a queued job; higher priorities go first."""
        return self._connection.ask(JobView, "PATCH", self._at(job), json={"priority": priority})

    def delete(self, job: str) -> None:
        """Delete a job that has ended, and its results."""
        self._connection.send("DELETE", self._at(job), repeatable=False)

    def results(self, job: str) -> list[ResultView]:
        """Return the files that a job has made so far, by name."""
        return [file for page in self._connection.pages(ResultPage, f"{self._at(job)}/results", "after") for file in page.results]

    def download(self, job: str, folder: Path, *, names: Sequence[str] | None = None, progress: Progress | None = None) -> list[Path]:
        """Download results, several files at once, and return their paths by name; an interrupted download is continued.

        Args:
            folder: to write the files into; it is made if it does not exist.
            names: of the files; None: all.
            progress: told of the stage `download`, in MiB.
        """
        found = self.results(job)
        if names is not None:
            if missing := sorted(set(names) - {file.name for file in found}):
                raise FileError(f"{job} has no result {missing[0]}")
            found = [file for file in found if file.name in names]
        told = TransferProgress(progress, "download", sum(file.size for file in found))
        return transfer_all((Download(self._connection, f"{self._at(job)}/results", file.name, folder, told).run for file in found),
                            parallel=self._parallel)

    def _act(self, job: str, action: str) -> JobView:
        return self._connection.ask(JobView, "POST", f"{self._at(job)}/{action}", repeatable=False)

    def _at(self, job: str) -> str:
        return self._connection.path(PATH, job)


HOOKS_PATH = "/v1/hooks"


class Hooks:
    """The hooks of a project."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def create(self, wanted: NewHook) -> NewHookView:
        """Create a hook, and return it with its secret, which is not shown again."""
        return self._connection.ask(NewHookView, "POST", HOOKS_PATH, json=wanted.model_dump(mode="json"), repeatable=False)

    def all(self) -> list[HookView]:
        """Return the hooks of the project, the oldest first."""
        return self._connection.ask(HookList, "GET", HOOKS_PATH).hooks

    def get(self, hook: str) -> HookView:
        """Return one hook."""
        return self._connection.ask(HookView, "GET", self._connection.path(HOOKS_PATH, hook))

    def test(self, hook: str) -> DeliveryView:
        """Queue a delivery of the type hook.test; `get` tells what came of it."""
        return self._connection.ask(DeliveryView, "POST", f"{self._connection.path(HOOKS_PATH, hook)}/test", repeatable=False)

    def delete(self, hook: str) -> None:
        """Delete a hook; what waits is not sent any more."""
        self._connection.send("DELETE", self._connection.path(HOOKS_PATH, hook), repeatable=False)
