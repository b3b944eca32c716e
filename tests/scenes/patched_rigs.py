"""Small rigs, plans and cues, written with json alone; and an address of the loopback for each process of a test run."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from stage.rig.cues import rig_digest
from stage.rig.patch import universe_values
from stage.rig.rig import read_rig
from tests.scenes.rigs import write_rig


def loopback() -> str:
    """An address of this process alone: the ports of sACN and Art-Net are fixed."""
    number = os.getpid()
    return f"127.{1 + number // 62500 % 250}.{number // 250 % 250}.{1 + number % 250}"


def write_rig_file(path: Path, directions: np.ndarray, *, host: str | None, universes: int = 1, dimmer: int | None = None, **options: Any
                   ) -> Path:
    """A rig of RGB lamps in these directions, dealt to universes in turn; with a master dimmer on this channel of each."""
    write_rig(path, directions, {name: [0.05 + (c == k) for c in range(3)] for k, name in enumerate("rgb")}, host=host, universes=universes,
              names="lamp {}", fixed=() if dimmer is None else ({"name": "Dimmer", "channel": dimmer, "value": 255},), **options)
    return path


def write_plan(folder: Path, *sequences: dict[str, Any], settle_s: float = 0, **fields: Any) -> Path:
    """A plan of these sequences, plan.json."""
    path = folder / "plan.json"
    path.write_text(json.dumps({"schema": "relit.plan/1", "settle_s": settle_s, "sequences": sequences, **fields}))
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
