"""Small rigs and cues, written with json alone; and an address of the loopback for each process of a test run."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from stage.rig.cues import rig_digest
from stage.rig.patch import universe_values
from stage.rig.rig import read_rig


def loopback() -> str:
    """An address of this process alone: the ports of sACN and Art-Net are fixed."""
    number = os.getpid()
    return f"127.{1 + number // 62500 % 250}.{number // 250 % 250}.{1 + number % 250}"


def write_rig_file(path: Path, directions: np.ndarray, *, host: str | None, universes: int = 1, protocol: str = "sacn",
                   bits: int = 8, **changes: Any) -> Path:
    """A rig of RGB lamps in these directions, dealt to universes in turn."""
    width = bits // 8
    lights = []
    for index, direction in enumerate(np.asarray(directions).tolist()):
        first = 1 + 3 * width * (index // universes)
        primaries = [{"name": name, "irradiance": [0.05 + (c == k) for c in range(3)]} for k, name in enumerate("rgb")]
        lights.append({"name": f"lamp {index}", "type": "distant", "direction": direction, "bits": bits, "primaries": primaries,
                       "address": {"protocol": protocol, "universe": 1 + index % universes, "host": host,
                                   "channels": {name: first + k * width for k, name in enumerate("rgb")}}})
    path.write_text(json.dumps({"schema": "relit.rig/1", "name": "dome", "lights": lights, **changes}))
    return path


def write_cues_file(path: Path, rig_path: Path, steps: np.ndarray, *, fps: float = 40.0, first: int = 1) -> Path:
    """Cues of steps [frames, emitters], 0…255 or 0…65535."""
    rig = read_rig(rig_path)
    full = np.array([2.0 ** rig.lights[index].bits - 1 for index, _ in rig.emitters])
    values = universe_values(rig, np.asarray(steps))
    frames = [{"frame": first + index, "levels": (row / full).tolist(),
               "dmx": [{"protocol": universe.protocol, "universe": universe.number, "values": found[index].tolist()}
                       for universe, found in values.items()]}
              for index, row in enumerate(steps)]
    path.write_text(json.dumps({"schema": "relit.cues/1", "rig": rig.name, "rig_digest": rig_digest(rig), "frames_per_second": fps,
                                "emitters": [[rig.lights[index].name, primary.name] for index, primary in rig.emitters], "frames": frames}))
    return path
