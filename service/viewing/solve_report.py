"""Read report.json beside maps: warnings, lights that disagree with the others, and intensities that the solve refined."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import BaseModel, ValidationError

from service.reporting.provenance import REPORT_FILE
from stage.errors import ResultError, storage


class _Suspect(BaseModel):
    image: str
    misfit: float


class _Factors(BaseModel):
    believed: bool
    factors: list[float] = []


class _Estimated(BaseModel):
    factors: list[float] | None = None


class _Found(BaseModel):
    light_intensities: _Estimated = _Estimated()
    light_factors: _Factors | None = None


class _Report(BaseModel):
    warnings: list[str] = []
    suspect_lights: list[_Suspect] = []
    found: _Found = _Found()


class SolveReport(NamedTuple):
    """Content of the report of a solve or a depth."""

    warnings: list[str]
    """Sentences."""
    suspects: dict[str, str]
    """A sentence for each image whose light disagrees with the others."""
    factors: np.ndarray | None
    """[lights] factors on the intensities of the manifest that the maps were solved with; None: all are 1."""


def read_report(maps: Path) -> SolveReport:
    """Read the report.json beside a maps.exr or depth.exr; where there is none, nothing is known."""
    path = maps.parent / REPORT_FILE
    if not path.is_file():
        return SolveReport([], {}, None)
    with storage("read", path):
        text = path.read_bytes()
    try:
        found = _Report.model_validate(json.loads(text))
    except (ValueError, ValidationError) as error:
        raise ResultError(f"{path}: is not a report of relit: solve again, or take it away") from error
    suspects = {suspect.image: f"disagrees with the other lights by {100 * suspect.misfit:.0f} %: check its direction and irradiance"
                for suspect in found.suspect_lights}
    return SolveReport(found.warnings, suspects, _factors(found.found))


def _factors(found: _Found) -> np.ndarray | None:
    """Return the factors that a solve estimated before it began, times those that it refined, or None where it did neither."""
    refined = found.light_factors
    factors = [np.array(values) for values in (found.light_intensities.factors,
                                               refined.factors if refined is not None and refined.believed else None)
               if values is not None]
    return np.prod(factors, axis=0) if factors else None
