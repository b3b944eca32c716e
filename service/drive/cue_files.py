"""The files of a drive: cues.csv and cues.json with the levels, and report.json."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from service.drive.quantisation import Quantised
from service.reporting.progress import Timings
from service.reporting.provenance import REPORT_FILE, report
from service.requests.drive import DriveRequest
from stage.files import write_text
from stage.rig.cues import CUES_FILE, Cues, FrameCue, UniverseCue, rig_digest, write_cues
from stage.rig.patch import universe_values
from stage.rig.rig import Rig
from stage.stack import fingerprint

DECIMALS = 7
"""The decimals of levels, less than half a step of 16 bits."""


def write_cue_files(request: DriveRequest, rig: Rig, quantised: Quantised, numbers: Sequence[int], rate: float,
                    sections: Mapping[str, object], warnings: Sequence[str], timings: Timings) -> tuple[Path, Path]:
    """Write the cues and the report into the folder of the request, each file whole or not at all; return cues.json and report.json."""
    request.out.mkdir(parents=True, exist_ok=True)
    levels = np.round(quantised.level, DECIMALS)
    names = [(rig.lights[index].name, primary.name) for index, primary in rig.emitters]
    universes = universe_values(rig, quantised.step)
    frames = tuple(FrameCue.model_construct(frame=number, levels=tuple(row.tolist()), dmx=tuple(
        UniverseCue.model_construct(protocol=universe.protocol, universe=universe.number, values=tuple(values[place].tolist()))
        for universe, values in universes.items())) for place, (number, row) in enumerate(zip(numbers, levels, strict=True)))
    cues = request.out / CUES_FILE
    write_cues(Cues.model_construct(schema_="relit.cues/1", rig=rig.name, rig_digest=rig_digest(rig), frames_per_second=rate,
                                    emitters=tuple(names), frames=frames), cues)
    lines = [f"{number},{_field(light)},{_field(primary)},{level:.{DECIMALS}g}\n" for number, row in zip(numbers, levels, strict=True)
             for (light, primary), level in zip(names, row.tolist(), strict=True)]
    write_text(request.out / "cues.csv", "frame,light,primary,level\n" + "".join(lines))
    inputs = {name: {"path": str(path), "content": fingerprint.digest(path)} for name in ("rig", "chart", "keys")
              if (path := getattr(request, name)) is not None}
    text = report(request, inputs=inputs, **sections, warnings=list(warnings), seconds=timings.seconds)
    write_text(request.out / REPORT_FILE, text)
    return cues, request.out / REPORT_FILE


def _field(text: str) -> str:
    """Return a text as a field of CSV."""
    return '"' + text.replace('"', '""') + '"' if any(sign in text for sign in ',"\n') else text
