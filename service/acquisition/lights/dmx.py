"""Lamps that are driven by DMX over sACN or Art-Net."""

import threading
from pathlib import Path

import numpy as np

from service.acquisition.lights.lights import Ask
from service.errors import RequestError
from service.play.outputs import Output, open_output
from service.play.play import KEEP_ALIVE_S, REPEAT_S, REPEATS, black_out, send
from service.play.show import Values, dark_values, driven_universes, hosts_of
from service.requests.play import PlayRequest
from stage.rig.patch import drive_steps, universe_values
from stage.rig.rig import Rig


class DmxSwitch:
    """Sends the universes of a rig, and sends them again while they stay as they are: packets may be lost, and fixtures take a silent
    source for lost."""

    def __init__(self, path: Path, rig: Rig) -> None:
        request = PlayRequest(cues=path, rig=path)
        hosts = hosts_of(driven_universes(path, rig))
        self._rig = rig
        self._outputs: dict[str, Output] = {protocol: open_output(protocol, found, request) for protocol, found in hosts.items()}
        self._dark = dark_values(hosts)
        self._lock, self._changed, self._closing = threading.Lock(), threading.Event(), False
        self._refused: RequestError | None = None
        self._thread = threading.Thread(target=self._keep_alive, name="relit-dmx", daemon=True)
        self._thread.start()

    def set(self, levels: np.ndarray) -> None:
        """Send the levels at once."""
        values: Values = {protocol: {} for protocol in self._outputs}
        for universe, channels in universe_values(self._rig, drive_steps(self._rig, levels[None])).items():
            values[universe.protocol][universe.number] = channels[0].tobytes()
        if self._refused is not None:
            raise self._refused
        with self._lock:
            send(self._outputs, values)
        self._changed.set()

    def close(self) -> None:
        """Send dark frames, and end the streams."""
        self._closing = True
        self._changed.set()
        self._thread.join()
        black_out(self._outputs, self._dark)

    def _keep_alive(self) -> None:
        left = 0
        while not self._closing:
            if self._changed.wait(REPEAT_S if left else KEEP_ALIVE_S):
                self._changed.clear()
                left = REPEATS
                continue
            left = max(0, left - 1)
            try:
                with self._lock:
                    for output in self._outputs.values():
                        output.send()
            except RequestError as error:
                self._refused = error  # said at the next change of the lamps
                return


def open_switch(path: Path, rig: Rig, ask: Ask) -> DmxSwitch:
    """Open the way to the lamps of a rig that are driven by DMX; nobody is asked."""
    return DmxSwitch(path, rig)
