"""Jobs: handed in, looked at, waited for, steered; and what they made."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from service.client.errors import FileError, JobEnded
from service.client.events import follow
from service.client.link import Link
from service.client.results import fetch
from service.client.tally import Tally
from service.reporting.progress import Progress
from service.requests.jobs import JobRequest
from service.server.api.views import JobPage, JobState, JobView, ResultPage, ResultView

SUCCEEDED = "succeeded"
PATH = "/v1/jobs"


class Jobs:
    """The jobs of a project."""

    def __init__(self, link: Link, *, parallel: int) -> None:
        """Args: link: to the service. parallel: results fetched at once."""
        self._link, self._parallel = link, parallel

    def submit(self, request: JobRequest, *, token: str | None = None) -> JobView:
        """Hand a job in.

        Args:
            request: a SolveJob, RelightJob … of service.requests.jobs.
            token: Idempotency-Key: the same request with the same token is the same job; None: a new job.

        Raises:
            Refused: it reads what is not there or not ready, or a value cannot be.
        """
        answer = self._link.send("POST", PATH, json=request.model_dump(mode="json", by_alias=True, exclude_defaults=True),
                                 headers={"Idempotency-Key": token or self._link.token()})
        return JobView.model_validate_json(answer.content)

    def get(self, job: str) -> JobView:
        """One job."""
        return JobView.model_validate_json(self._link.send("GET", self._at(job)).content)

    def all(self, states: Sequence[JobState] = ()) -> Iterator[JobView]:
        """Jobs, the newest first; of these states alone, where some are given."""
        before: str | None = None
        while True:
            answer = self._link.send("GET", PATH, params={"state": list(states)} | ({} if before is None else {"before": before}))
            page = JobPage.model_validate_json(answer.content)
            yield from page.jobs
            if (before := page.next) is None:
                return

    def follow(self, job: str) -> Iterator[JobView]:
        """The job as it is, then as it becomes with every change, until it has ended."""
        return follow(self._link, self._at(job))

    def wait(self, job: str, *, progress: Progress | None = None) -> JobView:
        """Wait until a job has succeeded.

        Args:
            job: its identifier.
            progress: told of its stages.

        Raises:
            JobEnded: it has failed, or was cancelled.
        """
        stage, ended = None, None
        for ended in self.follow(job):
            if progress is not None and ended.progress is not None:
                if (ended.progress.stage, ended.progress.total) != stage:
                    stage = ended.progress.stage, ended.progress.total
                    progress.stage(*stage)
                progress.advance(ended.progress.done)
        assert ended is not None, "there is always a first"
        if ended.state != SUCCEEDED:
            raise JobEnded(ended)
        return ended

    def cancel(self, job: str) -> JobView:
        """Stop a job; what it has made stays."""
        return self._steer(job, "cancel")

    def retry(self, job: str) -> JobView:
        """Begin a failed job again; what is done stays."""
        return self._steer(job, "retry")

    def resume(self, job: str) -> JobView:
        """Go on with a cancelled job."""
        return self._steer(job, "resume")

    def prioritise(self, job: str, priority: int) -> JobView:
        """Give a job that has not begun another priority: higher goes first."""
        return JobView.model_validate_json(self._link.send("PATCH", self._at(job), json={"priority": priority}).content)

    def delete(self, job: str) -> None:
        """Remove a job that has ended, and its results."""
        self._link.send("DELETE", self._at(job), repeatable=False)

    def results(self, job: str) -> list[ResultView]:
        """The files that a job has made so far, by name."""
        after: str | None = None
        found: list[ResultView] = []
        while True:
            answer = self._link.send("GET", f"{self._at(job)}/results", params={} if after is None else {"after": after})
            page = ResultPage.model_validate_json(answer.content)
            found += page.results
            if (after := page.next) is None:
                return found

    def download(self, job: str, folder: Path, *, names: Sequence[str] | None = None, progress: Progress | None = None) -> list[Path]:
        """Fetch what a job has made, several files at once; what was broken off is gone on with.

        Args:
            job: its identifier.
            folder: for the files; made where there is none.
            names: of files; None: all.
            progress: told of `download`, in MiB.

        Returns:
            Where they are now, by name.

        Raises:
            FileError: a name is not among the results, or a file cannot be written.
            ClientError: the service says no, or does not answer.
        """
        found = self.results(job)
        if names is not None:
            if missing := sorted(set(names) - {file.name for file in found}):
                raise FileError(f"{job} has no result {missing[0]}")
            found = [file for file in found if file.name in names]
        return fetch(self._link, f"{self._at(job)}/results", [file.name for file in found], folder, parallel=self._parallel,
                     tally=Tally(progress, "download", sum(file.size for file in found)))

    def _steer(self, job: str, action: str) -> JobView:
        return JobView.model_validate_json(self._link.send("POST", f"{self._at(job)}/{action}", repeatable=False).content)

    def _at(self, job: str) -> str:
        return self._link.path(PATH, job)
