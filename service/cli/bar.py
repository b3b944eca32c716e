"""Progress on a terminal; silence where the output is not one."""

import sys
from types import TracebackType
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from rich.progress import Progress as RichProgress
    from rich.progress import TaskID


class Bar:
    """A service.progress.Progress that draws one line a stage on standard error."""

    def __init__(self) -> None:
        """Nothing is drawn before the first stage, and nothing at all when standard error is not a terminal."""
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
