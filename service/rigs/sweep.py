"""Make cues that light one primary of a rig after another, at several levels, to measure the lamps by."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.drive.cue_files import TABLE_FILE, cues_of, write_table
from service.drive.levels import Quantised
from service.errors import RequestError
from service.requests.rig import RigSweepRequest
from stage.rig.cues import CUES_FILE, write_cues
from stage.rig.patch import light_at_drive
from stage.rig.rig import read_rig


class SweepResult(NamedTuple):
    """The files that were written."""

    cues: Path
    table: Path
    frames: int


def sweep_rig(request: RigSweepRequest) -> SweepResult:
    """Write cues.json and cues.csv: a dark frame, then every primary alone at even drives up to full level.
    Raises RequestError if the rig has no lamp of a name. Raises ManifestError if the rig is wrong; names the field. Raises StorageError if
    a file cannot be written."""
    rig = read_rig(request.rig)
    unknown = sorted(set(request.lights) - {lamp.name for lamp in rig.lights})
    if unknown:
        raise RequestError(f"--light {unknown[0]}: the rig {rig.name} has no lamp of this name")
    chosen = [(column, index, primary) for column, (index, primary) in enumerate(rig.emitters)
              if not request.lights or rig.lights[index].name in request.lights]
    shape = 1 + request.levels * len(chosen), len(rig.emitters)
    step, level = np.zeros(shape, dtype=np.int64), np.zeros(shape)
    rows = [(1, rig.lights[chosen[0][1]].name, chosen[0][2].name, 0.0)]
    for place, (column, index, primary) in enumerate(chosen):
        frames = 1 + place * request.levels + np.arange(request.levels)
        most = 2 ** rig.lights[index].bits - 1
        step[frames, column] = np.rint(np.linspace(0, most, request.levels + 1)[1:])
        level[frames, column] = light_at_drive(step[frames, column] / most, primary)
        rows += [(int(frame) + 1, rig.lights[index].name, primary.name, float(level[frame, column])) for frame in frames]
    request.out.mkdir(parents=True, exist_ok=True)
    cues = cues_of(rig, Quantised(step, level), range(1, shape[0] + 1), request.frames_per_second)
    write_cues(cues, request.out / CUES_FILE)
    write_table(request.out / TABLE_FILE, rows)
    return SweepResult(request.out / CUES_FILE, request.out / TABLE_FILE, shape[0])
