"""Progress of a command: a bar on a terminal, nothing where the output is none, or lines for the worker of a farm."""

import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Self, TypeVar

import typer

from service.requests.base.base import Choice

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID

Given = TypeVar("Given")
Result = TypeVar("Result")
COUNTED = ("frames", "shade")
"""The stages that count for the percentage of a farm; the others are short."""


class ProgressStyle(Choice):
    """The ways in which progress is shown."""

    BAR = "bar", "on a terminal, else not at all"
    OPENJD = "openjd", "lines that a farm's worker or another program reads (docs/farm.md)"


ProgressOption = Annotated[ProgressStyle, typer.Option("--progress", help=f"{ProgressStyle.explained()}.")]


def progress_in(style: ProgressStyle, counted: tuple[str, ...] | None = COUNTED) -> "ProgressBar | OpenJdProgress":
    """Return what shows progress in a style; `counted` as OpenJdProgress takes it."""
    return OpenJdProgress(counted) if style is ProgressStyle.OPENJD else ProgressBar()


class ProgressBar:
    """A service.reporting.progress.Progress that draws one line for each stage on standard error."""

    def __init__(self) -> None:
        self._task: TaskID | None = None
        self._bar: RichProgress | None = None
        if sys.stderr.isatty():
            from rich import progress
            from rich.console import Console

            text, part, elapsed = progress.TextColumn, progress.MofNCompleteColumn, progress.TimeElapsedColumn
            self._bar = progress.Progress(text("{task.description:<9}"), progress.BarColumn(), part(), elapsed(),
                                     console=Console(stderr=True))

    def __enter__(self) -> Self:
        """Start drawing."""
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Complete the last line, unless an error ended it, and stop drawing."""
        if self._bar is not None:
            if error is None:
                self._finish()
            self._bar.stop()

    def stage(self, name: str, total: int) -> None:
        """Begin a line."""
        if self._bar is not None:
            self._finish()
            self._task = self._bar.add_task(name, total=total)

    def advance(self, done: int) -> None:
        """Move the current line."""
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=done)

    def _finish(self) -> None:
        if self._bar is not None and self._task is not None:
            task = self._bar.tasks[self._task]
            self._bar.update(self._task, completed=task.total)


def with_bar(work: "Callable[[Given, ProgressBar | OpenJdProgress], Result]", request: Given,
             style: ProgressStyle = ProgressStyle.BAR) -> Result:
    """Do the work of a request, and show the progress of each of its stages."""
    with progress_in(style, counted=None) as bar:
        return work(request, bar)


class OpenJdProgress(AbstractContextManager["OpenJdProgress"]):
    """A service.reporting.progress.Progress that prints on standard output what the task does, and how much of it is done.

    Args:
        counted: the stages whose percentages are those of the task; None: each stage has its own, from 0.

    Source: Open Job Description, How Jobs Are Run, Stdout/Stderr Messages.
    """

    def __init__(self, counted: tuple[str, ...] | None = COUNTED) -> None:
        self._stage, self._total, self._told, self._counted = "", 0, -1, counted

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        """Print that all is done, unless an error ended it."""
        if error is None:
            print("openjd_progress: 100", flush=True)

    def stage(self, name: str, total: int) -> None:
        """Print the name of the stage that begins."""
        self._stage, self._total = name, total
        if self._counted is None:
            self._told = -1
        print(f"openjd_status: {name}", flush=True)

    def advance(self, done: int) -> None:
        """Print each whole percentage once."""
        percent = 100 * done // max(self._total, 1)
        if (self._counted is None or self._stage in self._counted) and self._told < percent < 100:
            self._told = percent
            print(f"openjd_progress: {percent}", flush=True)
