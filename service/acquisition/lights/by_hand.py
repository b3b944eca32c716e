"""Lamps that a person holds or switches: Relit says which one, and waits until it is done."""

from pathlib import Path

import numpy as np

from service.acquisition.lights.lights import Ask, lamp_levels
from stage.rig.rig import Rig


class HandSwitch:
    """Asks the person at the rig for each change."""

    def __init__(self, rig: Rig, ask: Ask) -> None:
        self._rig, self._ask = rig, ask
        self._shining: set[int] = set()

    def set(self, levels: np.ndarray) -> None:
        """Ask for the lamps that shall shine, if they are not those that do."""
        wanted = {index for index, level in lamp_levels(self._rig, levels, ("manual",)).items() if level > 0}
        if wanted == self._shining:
            return
        lamps = [f"{self._rig.lights[index].name} ({_place(self._rig, index)})" for index in sorted(wanted)]
        all_lamps = len(wanted) == sum(lamp.address is not None and lamp.address.protocol == "manual" for lamp in self._rig.lights)
        self._ask("turn all lamps off" if not wanted else "turn all lamps on" if all_lamps and len(wanted) > 1 else
                  f"light {', '.join(lamps)} and no other lamp")
        self._shining = wanted

    def close(self) -> None:
        """Do nothing: the person sees the end of the capture."""


def _place(rig: Rig, index: int) -> str:
    """Return where a lamp stands, as the camera sees it, in words."""
    x, y, z = rig.directions[index]
    around, up = np.degrees(np.arctan2(x, z)), np.degrees(np.arcsin(np.clip(y, -1, 1)))
    return f"{abs(around):.0f}° to the {'right' if around >= 0 else 'left'}, {abs(up):.0f}° {'up' if up >= 0 else 'down'}"


def open_switch(path: Path, rig: Rig, ask: Ask) -> HandSwitch:
    """Return the lamps that a person switches."""
    return HandSwitch(rig, ask)
