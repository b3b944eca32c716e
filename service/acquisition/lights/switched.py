"""Lamps that a controller switches by commands, each for one lamp, or one for all of them to turn dark."""

from typing import Protocol

import numpy as np

from service.acquisition.lights.lights import lamp_levels
from service.errors import RequestError
from stage.rig.controllers import filled, per_lamp
from stage.rig.rig import Rig


class Line(Protocol):
    """The line to a controller."""

    def send(self, command: str) -> None:
        """Send a command and wait until the controller has taken it; raises RequestError where it does not."""

    def close(self) -> None:
        """Let go of the line."""


class SwitchedLamps:
    """Lamps behind a line; the commands that change them are sent, and no others."""

    def __init__(self, rig: Rig, protocol: str, line: Line, on: str, off: str) -> None:
        """Turn all lamps dark, in case that some shine."""
        self._rig, self._protocol, self._line, self._on, self._off = rig, protocol, line, on, off
        self._lamps = sorted(lamp_levels(rig, np.zeros(len(rig.emitters)), (protocol,)))
        self._shining: dict[int, float] = dict.fromkeys(self._lamps, 1.0)
        try:
            self.set(np.zeros(len(rig.emitters)))
        except RequestError:
            line.close()
            raise

    def set(self, levels: np.ndarray) -> None:
        """Turn those lamps dark that shall not shine, then light the others."""
        wanted = {index: level for index, level in lamp_levels(self._rig, levels, (self._protocol,)).items() if level > 0}
        leave = [index for index in self._shining if index not in wanted]
        if leave and not per_lamp(self._off):
            self._line.send(filled(self._off, leave[0], self._rig.lights[leave[0]].name, 0.0))
            self._shining.clear()
        for index in leave:
            if index in self._shining:
                self._line.send(filled(self._off, index, self._rig.lights[index].name, 0.0))
                del self._shining[index]
        for index, level in wanted.items():
            if self._shining.get(index) != level:
                self._line.send(filled(self._on, index, self._rig.lights[index].name, level))
                self._shining[index] = level

    def close(self) -> None:
        """Turn the lamps dark, and let go of the line."""
        try:
            self.set(np.zeros(len(self._rig.emitters)))
        finally:
            self._line.close()
