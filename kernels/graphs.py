"""Launches that are done many times with the same arguments, as graphs where the device has them."""

from collections.abc import Callable

import warp as wp


def has_graphs(device: str) -> bool:
    """Return whether launches on this device wait in a queue, so that a graph of them saves their starts."""
    return bool(wp.get_device(device).is_cuda)


class Repeated:
    """Launches that are done many times with the same arguments: on CUDA one graph, captured when they are first done.

    Args:
        work: makes the launches, whose arguments must not change from run to run where the device has graphs. It reads nothing back and
            allocates nothing, and the arrays live as long as this object.
        device: where.
    """

    def __init__(self, work: Callable[[], None], device: str) -> None:
        self._work, self.device, self._graph = work, device, None

    def run(self) -> None:
        """Do the launches; returns as `launch` does."""
        if not has_graphs(self.device):
            self._work()
            return
        if self._graph is None:
            with wp.ScopedCapture(self.device) as capture:
                self._work()
            self._graph = capture.graph
        wp.capture_launch(self._graph)
