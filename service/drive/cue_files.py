"""The files of a drive: cues.csv and cues.json with the levels, and report.json with what the lamps cannot give."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from service.drive.judgement import Judgement
from service.drive.levels import Dilated, Quantised, WantedLevels
from service.drive.light import ChartView, Light
from service.relight.environments import Environments
from service.reporting.progress import Timings
from service.reporting.provenance import REPORT_FILE, report
from service.requests.drive import DriveRequest
from stage.files import write_text
from stage.formats.csv_table import table_text
from stage.rig.cues import CUES_FILE, Cues, FrameCue, UniverseCue, rig_digest, write_cues
from stage.rig.patch import patch_faults, universe_values
from stage.rig.rig import Rig
from stage.stack import fingerprint

TABLE_FILE = "cues.csv"
DECIMALS = 7
"""The decimals of levels, less than half a step of 16 bits."""


def write_cue_files(request: DriveRequest, rig: Rig, quantised: Quantised, numbers: Sequence[int], rate: float,
                    sections: Mapping[str, object], warnings: Sequence[str], timings: Timings) -> tuple[Path, Path]:
    """Write the cues and the report into the folder of the request, each file whole or not at all; return cues.json and report.json."""
    request.out.mkdir(parents=True, exist_ok=True)
    cues = request.out / CUES_FILE
    made = cues_of(rig, quantised, numbers, rate)
    write_cues(made, cues)
    write_table(request.out / TABLE_FILE, ((frame.frame, *name, level) for frame in made.frames
                                           for name, level in zip(made.emitters, frame.levels, strict=True)))
    inputs = {name: {"path": str(path), "content": fingerprint.digest(path)} for name in ("rig", "chart", "keys")
              if (path := getattr(request, name)) is not None}
    text = report(request, inputs=inputs, **sections, warnings=list(warnings), seconds=timings.seconds)
    write_text(request.out / REPORT_FILE, text)
    return cues, request.out / REPORT_FILE


def cues_of(rig: Rig, quantised: Quantised, numbers: Sequence[int], rate: float) -> Cues:
    """Return the cues of levels that the lamps of a rig can hold, at `rate` frames per second."""
    universes = universe_values(rig, quantised.step)
    frames = tuple(FrameCue.model_construct(frame=number, levels=tuple(row.tolist()), dmx=tuple(
        UniverseCue.model_construct(protocol=universe.protocol, universe=universe.number, values=tuple(values[place].tolist()))
        for universe, values in universes.items()))
        for place, (number, row) in enumerate(zip(numbers, np.round(quantised.level, DECIMALS), strict=True)))
    return Cues.model_construct(schema_="relit.cues/1", rig=rig.name, rig_digest=rig_digest(rig), frames_per_second=rate, frames=frames,
                                emitters=tuple((rig.lights[index].name, primary.name) for index, primary in rig.emitters))


def write_table(path: Path, rows: Iterable[tuple[int, str, str, float]]) -> None:
    """Write a table of frame, lamp, primary and level whole or not at all."""
    write_text(path, table_text(("frame", "light", "primary", "level"), ((*where, f"{level:.{DECIMALS}g}") for *where, level in rows)))


WORTH_SAYING = 0.01
"""Parts of the light from here on are worth a warning."""


def drive_warnings(rig: Rig, light: Light, wanted: WantedLevels, dilated: Dilated, exposure: np.ndarray,
                   environments: Environments | None, rounded: np.ndarray) -> list[str]:
    """Return what the user should know, a sentence each; the levels are those of the light times the exposure [frames]. `rounded`: [frames]
    error of the irradiance that the steps of the lamps make."""
    found = []
    if (faults := list(patch_faults(rig))):
        found.append(f"{len(faults)} faults of the patch keep lamps dark in relit play, the first: {faults[0]} (relit rig check)")
    if (beyond := float(light.beyond.max())) > WORTH_SAYING:
        found.append(f"up to {beyond:.0%} of the light comes from where no lamp stands")
    if dilated.radius.max() > 0:
        found.append(f"lamps are at their limit in {int((dilated.radius > 0).sum())} frames: what they cannot give is spread over lamps up "
                     f"to {np.degrees(dilated.radius.max()):.0f} degrees around")
    total = np.maximum(light.energy.sum(axis=(1, 2)) * exposure, np.finfo(float).tiny)
    if (gamut := float((wanted.out_of_gamut.sum(axis=1) / total).max())) > WORTH_SAYING:
        found.append(f"the colours of the lamps miss up to {gamut:.0%} of the light: its colours lie outside theirs")
    if (most := float(rounded.max())) > WORTH_SAYING:
        found.append(f"the steps of the lamps and the least light that they hold make up to {most:.0%} of error: give more exposure, or "
                     "lamps of finer steps")
    if environments is not None and environments.clipped:
        found.append(f"{sum(environments.clipped.values())} pixels of environments were negative and are 0")
    return [*found, *(environments.doubts() if environments is not None else [])]


def report_sections(light: Light, wanted: WantedLevels, dilated: Dilated, quantised: Quantised, judgement: Judgement, unrounded: Judgement,
                    rig: Rig, exposure: float, numbers: Sequence[int], chart: ChartView | None) -> dict[str, object]:
    """Return the sections of the report."""
    change = np.abs(np.diff(quantised.level, axis=0)).max(initial=0)
    share = np.abs(np.diff(wanted.level, axis=0)).max(initial=0)
    return {
        "rig": {"name": rig.name, "lights": len(rig.lights), "emitters": len(rig.emitters)},
        "exposure": exposure,
        "irradiance_error": {"rms_percent": _spread(100 * judgement.rms), "chromaticity_uv": _spread(judgement.chromaticity),
                             "energy": _spread(judgement.energy),
                             "quantisation_percent": _spread(100 * np.abs(judgement.rms - unrounded.rms))},
        **({} if chart is None else {"chart": {"rms_percent": _spread(100 * chart.rms)}}),
        "limits": {"frames": int((dilated.radius > 0).sum()), "dilation_degrees": float(np.degrees(dilated.radius.max())),
                   "left_out": dilated.left.sum(axis=0).tolist(), "out_of_gamut": wanted.out_of_gamut.sum(axis=0).tolist(),
                   "beyond_share": float(light.beyond.max())},
        "change": {"largest_of_a_level": float(change), "largest_of_a_share": float(share)},
        "frames": [{"frame": number, "rms_percent": float(100 * rms), "chromaticity_uv": float(uv), "energy": float(energy),
                    "dilation_degrees": float(np.degrees(radius))}
                   for number, rms, uv, energy, radius in zip(numbers, *judgement, dilated.radius, strict=True)],
    }


def _spread(values: np.ndarray) -> dict[str, float]:
    return {"median": float(np.median(values)), "largest": float(values.max())}
