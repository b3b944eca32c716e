"""Work in a thread beside Blender: its progress, its end in Blender's own thread, and cancelling.

Convention:
    `work` runs in a thread and never touches bpy. A timer asks for its end, and then `finish`, which may, runs in Blender's own thread. The
    timer goes when another file is opened: the work ends then without `finish`, and its files are there.
"""

import threading
from collections.abc import Callable

import bpy

INTERVAL_S = 0.2
"""Seconds between two looks of the timer."""


class Failure(Exception):
    """Work could not be done; the text is one sentence for the user."""


class Cancelled(Exception):
    """The user has cancelled the work."""


class Task:
    """One piece of work, as the panel shows it."""

    def __init__(self, title: str) -> None:
        self.title, self.stage, self.percent = title, "", 0
        self.error: str | None = None
        self.result: object = None
        self.ended = False
        self._cancelled = threading.Event()
        self._stop: Callable[[], None] | None = None

    def tell(self, stage: str, percent: int) -> None:
        """Take note of the stage and of how much of it is done; raise Cancelled if the user wants no more."""
        if self._cancelled.is_set():
            raise Cancelled
        self.stage, self.percent = stage, percent

    def stoppable(self, stop: Callable[[], None] | None) -> None:
        """Set what ends that for which the thread waits."""
        self._stop = stop
        if stop is not None and self._cancelled.is_set():
            stop()

    def cancel(self) -> None:
        """Ask the thread to end."""
        self._cancelled.set()
        stop = self._stop  # once, since the thread may take it away meanwhile
        if stop is not None:
            stop()

    @property
    def cancelled(self) -> bool:
        """Return True if the user has cancelled the work."""
        return self._cancelled.is_set()

    def run(self, work: "Callable[[Task], object]") -> None:
        """Do the work, and keep its result or the sentence that says why there is none."""
        try:
            self.result = work(self)
        except Cancelled:
            self.error = f"{self.title} is cancelled"
        except Failure as error:
            self.error = str(error)
        except Exception as error:  # of any kind: the panel says so and stays usable
            self.error = f"{self.title} failed: {type(error).__name__}: {error}"
        self.ended = True


current: Task | None = None
"""The task under way, or the last one."""
_finish: Callable[[object], object] | None = None


def require_free() -> None:
    """Raise Failure if work is under way."""
    if current is not None and not current.ended:
        raise Failure(f"{current.title} is under way: wait for it, or cancel it")


def start(title: str, work: Callable[[Task], object], finish: Callable[[object], object], *, wait: bool) -> None:
    """Begin work, if none is under way; with `wait` return when it has ended.

    Raises:
        Failure: another task is under way; with `wait` also if this one failed.
    """
    global current, _finish
    require_free()
    current, _finish = Task(title), finish
    if wait:
        current.run(work)
        poll()
        if current.error is not None:
            raise Failure(current.error)
        return
    threading.Thread(target=current.run, args=(work,), daemon=True).start()
    if not bpy.app.timers.is_registered(poll):
        bpy.app.timers.register(poll, first_interval=INTERVAL_S)


def poll() -> float | None:
    """Finish a task that has ended; return the seconds until the next look, or None after the last one, as Blender's timers ask."""
    global _finish
    redraw()
    if current is None or not current.ended:
        return INTERVAL_S if current is not None else None
    finish, _finish = _finish, None
    if finish is not None and current.error is None:
        try:
            with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):  # a timer has none
                finish(current.result)
        except Exception as error:  # as in Task.run
            current.error = str(error) if isinstance(error, Failure) else f"{current.title} failed: {type(error).__name__}: {error}"
    return None


def stop() -> None:
    """Cancel the task and forget it, when the extension is removed."""
    global current, _finish
    if current is not None:
        current.cancel()
    if bpy.app.timers.is_registered(poll):
        bpy.app.timers.unregister(poll)
    current = _finish = None


def redraw() -> None:
    """Draw the panels anew, where there are any."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()
