"""Intensities of lights that the captures of a sequence share: what its first step asks for, unless the images of a step contradict.

The lights of a rig do not change between steps, and intensities that each step finds for itself would make its surface flicker.
"""

from typing import Any

import numpy as np

from service.solve.intensities import ChosenIntensities, choose_intensities, lambertian_misfit
from service.solve.solution import SolveInput
from stage.point_lights import DistantLights

CONTRADICTED = 0.8
"""Misfit under a step's own intensities, over that under the shared ones, below which the step takes its own."""


class LightsOverTime:
    """The intensities of the first step, for those after it."""

    def __init__(self, *, shared: bool) -> None:
        """Args: shared: whether intensities are chosen at all; else every step has those of its manifest."""
        self._shared = shared
        self._first: dict[str, Any] | None = None

    def choose(self, given: SolveInput, lights: DistantLights) -> ChosenIntensities:
        """Return the lights of a step with the shared intensities, or its own where its images contradict them.

        Args:
            given: the images.
            lights: lights of the stack, as declared.
        """
        own = choose_intensities(given, lights)
        declared = {"direction": lights.direction.tolist(), "irradiance": lights.irradiance.tolist()}
        if self._first is None:
            factor = np.divide(own.lights.irradiance, lights.irradiance, out=np.ones_like(lights.irradiance), where=lights.irradiance > 0)
            self._first = declared | {"factor": factor.max(axis=1).tolist()}
            return own
        if any(declared[name] != self._first[name] for name in declared):
            return _said(own, "its own: the lights of the manifest are not those of the first step")
        factor = np.array(self._first["factor"])
        if (factor == 1).all() and own.lights is lights:
            return own
        common = lights._replace(irradiance=lights.irradiance * factor[:, None])
        if lambertian_misfit(given, own.lights) < CONTRADICTED * lambertian_misfit(given, common):
            return _said(own, "its own: the images contradict those of the first step")
        return ChosenIntensities(common, {"light_intensities": {"used": "those of the first step"}})

    def left(self) -> dict[str, Any]:
        """Return what a step leaves for those after it."""
        return {"lights": self._first}

    def take(self, left: dict[str, Any]) -> None:
        """Take what a step has left, which was perhaps done before."""
        if self._first is None and isinstance(left.get("lights"), dict):
            self._first = left["lights"]

    def plain(self) -> Any:
        """Return what a step follows from beside its capture, as plain data."""
        return self._first


def _said(own: ChosenIntensities, why: str) -> ChosenIntensities:
    return own._replace(facts={"light_intensities": {**own.facts.get("light_intensities", {}), "over_time": why}})
