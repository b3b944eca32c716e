"""Lamps of a controller at a serial port, which takes a line of text for each change and may answer with one (pyserial)."""

import os
import re
import time
from pathlib import Path

import serial

from service.acquisition.lights.lights import Ask
from service.acquisition.lights.switched import SwitchedLamps
from service.errors import RequestError
from stage.rig.controllers import SerialController
from stage.rig.rig import Rig


class SerialLine:
    """The line to a controller."""

    def __init__(self, path: Path, controller: SerialController) -> None:
        self._controller, self._where = controller, f"{path}: controllers.serial: {controller.port}"
        try:
            self._port = serial.Serial(controller.port, controller.baud, timeout=controller.timeout_s, write_timeout=controller.timeout_s,
                                       exclusive=True)
        except (serial.SerialException, OSError, ValueError) as error:
            raise RequestError(f"{self._where}: cannot be opened: {_reason(error)}: check the cable, the port's name and that no other "
                               "program uses it") from error
        time.sleep(controller.ready_s)

    def send(self, command: str) -> None:
        """Send a command, and wait for the answer if the controller answers.
        Raises RequestError if it does not answer in time, or otherwise."""
        try:
            self._port.reset_input_buffer()
            self._port.write(command.encode())
            self._port.flush()
            if self._controller.acknowledge is None:
                return
            answer = self._port.readline().decode("utf-8", "replace").strip()
        except (serial.SerialException, OSError) as error:
            raise RequestError(f"{self._where}: {command.strip()!r} cannot be sent: {_reason(error)}: check the cable and the power"
                               ) from error
        if not answer:
            raise RequestError(f"{self._where}: no answer to {command.strip()!r} within {self._controller.timeout_s:g} s: check the cable, "
                               "the power and controllers.serial.baud")
        if re.search(self._controller.acknowledge, answer) is None:
            raise RequestError(f"{self._where}: answers {answer[:60]!r} to {command.strip()!r}, which is not "
                               f"{self._controller.acknowledge!r}")

    def close(self) -> None:
        """Let go of the port."""
        self._port.close()


def _reason(error: Exception) -> str:
    """Return why the system refuses, in its words where it has any."""
    return os.strerror(error.errno).lower() if isinstance(error, OSError) and error.errno else str(error)


def open_switch(path: Path, rig: Rig, ask: Ask) -> SwitchedLamps:
    """Open the way to the lamps at a serial port; nobody is asked."""
    controller = rig.controllers.serial
    assert controller is not None  # the rig is checked
    return SwitchedLamps(rig, "serial", SerialLine(path, controller), controller.on, controller.off)
