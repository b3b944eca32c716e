"""A thread that does its work again and again, with pauses, until it is stopped."""

import threading
from collections.abc import Callable


class Rounds:
    """Base of what the service does in rounds, in a thread of its own."""

    def __init__(self, name: str, every_s: float, work: Callable[[], None]) -> None:
        """Create the thread; `work`, which must catch its errors, does one round."""
        self._every_s, self._work = every_s, work
        self._wake, self._ended = threading.Event(), False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Start the thread, which begins with a round."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread, and wait for the end of its round."""
        self._ended = True
        self._wake.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._ended:
            self._work()
            self._wake.wait(self._every_s)
            self._wake.clear()
