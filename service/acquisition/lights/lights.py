"""The interface that every way to switch lamps has, and the lamps of a rig, each switched by the way of its address."""

import socket
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

import numpy as np

from service.errors import RequestError
from stage.rig.rig import DMX, Address, Rig

ADAPTERS = {"sacn": "dmx", "artnet": "dmx", "serial": "serial_line", "http": "http_requests", "manual": "by_hand"}
"""The module of each protocol of an address. A new one is a module with a function `open_switch(path, rig, ask)`, and an entry here."""

Ask = Callable[[str], None]
"""Asks a person to do something, and returns when it is done; raises RequestError where nobody can be asked."""
PLEASE, THEN_ENTER = "please   ", ", then press Enter"
"""How a line of `relit capture` begins that is for a person, and how it ends where the capture waits until that is done."""


class Switch(Protocol):
    """Switches the lamps of one way; others are left alone."""

    def set(self, levels: np.ndarray) -> None:
        """Let the lamps shine at levels [emitters] of the rig, and return when they have been told.
        Raises RequestError if the lamps do not answer."""

    def close(self) -> None:
        """Turn the lamps dark, as far as they can be reached, and let go of the line."""


class Lights:
    """All lamps of a rig."""

    def __init__(self, path: Path, rig: Rig, ask: Ask) -> None:
        """Open the ways to the lamps; nothing is switched yet.
        `path`: of the rig, for messages. `ask`: asks the person who holds a lamp. Raises RequestError if a package or a device is missing.
        Raises ManifestError if a lamp has no address, or one that cannot be used."""
        self._switches: list[Switch] = []
        self._held = ExitStack()
        protocols = {lamp.address.protocol for lamp in rig.lights if lamp.address is not None}
        try:
            self._hold(path, rig)
            for module in sorted({ADAPTERS[protocol] for protocol in protocols}):
                try:
                    adapter = import_module(f"service.acquisition.lights.{module}")
                except ModuleNotFoundError as error:
                    raise RequestError(f"{path}: lights[].address.protocol: {module.replace('_', ' ')} needs the package {error.name}, "
                                       "which is not installed: pip install 'relit[set]'") from error
                self._switches.append(adapter.open_switch(path, rig, ask))
        except BaseException:
            self.close()
            raise

    def set(self, levels: np.ndarray) -> None:
        """Let the lamps shine at levels [emitters]."""
        for switch in self._switches:
            switch.set(levels)

    def close(self) -> None:
        """Turn all lamps dark, those of each way also where another one fails, and raise the first failure."""
        refused: RequestError | None = None
        for switch in self._switches:
            try:
                switch.close()
            except RequestError as error:
                refused = refused or error
        self._switches.clear()
        self._held.close()
        if refused is not None:
            raise refused

    def _hold(self, path: Path, rig: Rig) -> None:
        """Refuse lamps that another capture on this machine switches: each would take pictures under the light of the other."""
        for place in sorted({_place(rig, lamp.address) for lamp in rig.lights if lamp.address is not None} - {""}):
            try:  # a name without a file, of 107 bytes at most, that is free when the process has ended
                self._held.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)).bind(f"\0relit lamps {place}"[:100].encode())
            except OSError as error:
                raise RequestError(f"{path}: lights[].address: the lamps of {place} are switched by another capture on this machine: wait "
                                   "until that has ended, or stop it") from error


def _place(rig: Rig, address: Address) -> str:
    """Return what lamps that one program at a time can switch have in common; empty: a person holds the lamp, or the port is exclusive."""
    if address.protocol in DMX:
        return f"{address.protocol} universe {address.universe}" + (f" at {address.host}" if address.host else "")
    return urlsplit(rig.controllers.http.on.url).netloc if address.protocol == "http" and rig.controllers.http is not None else ""


def lamp_levels(rig: Rig, levels: np.ndarray, protocols: Sequence[str]) -> dict[int, float]:
    """Return the greatest level among the primaries of each lamp that has one of some protocols, by the lamp's index."""
    found: dict[int, float] = {}
    for (index, _), level in zip(rig.emitters, levels.tolist(), strict=True):
        address = rig.lights[index].address
        if address is not None and address.protocol in protocols:
            found[index] = max(found.get(index, 0.0), level)
    return found
