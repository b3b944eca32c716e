"""The report of a drive, and the sentences about what the lamps cannot give."""

from collections.abc import Sequence

import numpy as np

from service.drive.dilation import Dilated
from service.drive.judgement import Judgement
from service.drive.light import Light
from service.drive.primaries import WantedLevels
from service.drive.quantisation import Quantised
from service.relight.environments import Environments
from stage.rig.patch import patch_faults
from stage.rig.rig import Rig

WORTH_SAYING = 0.01
"""Parts of the light from here on are worth a warning."""


def drive_warnings(rig: Rig, light: Light, wanted: WantedLevels, dilated: Dilated, exposure: np.ndarray,
                   environments: Environments | None) -> list[str]:
    """Return what the user should know, a sentence each; the levels are those of the light times the exposure [frames]."""
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
    if environments is not None and environments.clipped:
        found.append(f"{sum(environments.clipped.values())} pixels of environments were negative and are 0")
    return found


def report_sections(light: Light, wanted: WantedLevels, dilated: Dilated, quantised: Quantised, judgement: Judgement, unrounded: Judgement,
                    rig: Rig, exposure: float, numbers: Sequence[int]) -> dict[str, object]:
    """Return the sections of the report."""
    change = np.abs(np.diff(quantised.level, axis=0)).max(initial=0)
    share = np.abs(np.diff(wanted.level, axis=0)).max(initial=0)
    return {
        "rig": {"name": rig.name, "lights": len(rig.lights), "emitters": len(rig.emitters)},
        "exposure": exposure,
        "irradiance_error": {"rms_percent": _spread(100 * judgement.rms), "chromaticity_uv": _spread(judgement.chromaticity),
                             "energy": _spread(judgement.energy),
                             "quantisation_percent": _spread(100 * np.abs(judgement.rms - unrounded.rms))},
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
