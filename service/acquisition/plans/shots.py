"""The pictures of a plan in the order in which they are taken, with what lights each and its entry in the manifest."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.acquisition.plans.plan import (
    AnySequence,
    BallSequence,
    ChartSequence,
    DarkSequence,
    FlatSequence,
    GradientSequence,
    OlatSequence,
    PatternSequence,
    Plan,
    ResponseSequence,
    needs_projector,
)
from service.depth.patterns.projection import patterns_of
from service.errors import RequestError
from service.requests.patterns import PatternsRequest
from stage.capture.light import DistantLight, FullLight, GradientLight, Light, OffLight, PointLight
from stage.patterns.base import UniformPattern
from stage.patterns.codes import Pattern
from stage.rig.rig import DMX, Rig

AXES = ("x", "y", "z")
FLAT = "flat"
"""The name of the flat image."""
TRACKING = "tracking"
"""The end of the names of pictures under full light, which show whether something moved; of white ones between patterns also the folder."""

SEEN = 4
"""Number of lamps around a surface that light it together as one at normal incidence does."""


class Shot(NamedTuple):
    """One picture that is to be taken."""

    name: str
    """The name of its file without suffix, unlike those of other shots of its folder."""
    folder: str
    """The folder of its capture within that of the plan; empty: the capture itself."""
    levels: np.ndarray
    """[emitters] of the rig, the light of each, 0 to 1 of full."""
    lamp: int | None = None
    """The index of the lamp that shines alone; None: several or none do."""
    light: Light | None = None
    """The entry `light` of its frame; None: a pattern lights it, or it is the flat image."""
    pattern: Pattern | None = None
    """The entry `pattern` of its frame, and what the projector shows."""
    grey: float | None = None
    """The level, 0 to 1 of full, that the projector shows everywhere; of no frame. None: none."""
    exposure_s: float | None = None
    """The exposure time; None: the one that the camera has."""
    may_clip: bool = False
    """Whether a shorter exposure of the same light shows what this one clips."""
    prompt: str | None = None
    """What a person does before it; None: nothing."""

    @property
    def key(self) -> str:
        """Return the name of the shot within the plan."""
        return f"{self.folder}/{self.name}" if self.folder else self.name

    @property
    def projected(self) -> bool:
        """Return whether the projector lights the picture."""
        return self.pattern is not None or self.grey is not None


def shots_of(plan: Plan, rig: Rig, projector: tuple[int, int] | None) -> tuple[Shot, ...]:
    """Return the shots of a plan.
    `projector`: width and height of the projector in pixels; None: there is none. Raises RequestError if the plan names a lamp that the rig
    lacks, shows patterns without a projector, or has no picture of the object."""
    if not rig.lights and not all(needs_projector([sequence]) for sequence in plan.sequences):
        raise RequestError("the plan has pictures under lamps: give the file of the lamps, --rig rig.json")
    found: list[Shot] = []
    tracked: dict[str, tuple[Shot, int]] = {}  # the first tracking shot of lamps and that of patterns, and the shots since, by the folder
    shown: set[Pattern] = set()  # codes share white and black, of which a capture has one each
    for number, sequence in enumerate(plan.sequences):
        before = len(found)
        for shot in _sequence(sequence, rig, projector, f"sequences[{number}]"):
            if shot.pattern is not None and shot.pattern in shown:
                continue
            if shot.pattern is not None:
                shown.add(shot.pattern)
            times = sequence.exposures_s or (None,)
            if plan.tracking_every is not None and isinstance(sequence, OlatSequence | GradientSequence | PatternSequence):
                tracking = _tracking(rig, sequence)._replace(exposure_s=min(sequence.exposures_s, default=None))
                first, since = tracked.get(tracking.folder, (tracking, 0))
                if since % plan.tracking_every == 0:
                    found.append(tracking)
                tracked[tracking.folder] = first, since + 1
            found += [shot._replace(exposure_s=time, may_clip=time is not None and time > min(filter(None, times))) for time in times]
        if len(found) > before:
            found[before] = found[before]._replace(prompt=sequence.prompt)
    found += [tracking for tracking, _ in tracked.values()]
    _refuse_some_exposures(found)
    patterns = next((index for index, shot in enumerate(found) if shot.pattern is not None), len(found))
    if any(shot.grey is not None for shot in found[patterns:]):
        raise RequestError("the plan measures the projector's response after patterns that are shown through it: put it before them")
    if sum(shot.name == FLAT for shot in found) > 1:
        raise RequestError("the plan has several flat images: a capture has one, so give one sequence flat with one exposure")
    return tuple(_named(found))


def _refuse_some_exposures(shots: Sequence[Shot]) -> None:
    """Refuse a plan whose captures would have exposure times for some of their frames alone."""
    for folder in dict.fromkeys(shot.folder for shot in shots):  # in the order of the plan
        frames = [shot for shot in shots if shot.folder == folder and (shot.light is not None or shot.pattern is not None)]
        without = [shot.key for shot in frames if shot.exposure_s is None]
        if 0 < len(without) < len(frames):
            raise RequestError(f"the plan has exposures_s for some pictures of a capture and none for {without[0]}: give them to all of "
                               "its sequences or to none")


def refuse_dimming(shots: Sequence[Shot], rig: Rig) -> None:
    """Refuse shots under parts of the light of lamps that are only switched. Raises RequestError, which names a lamp."""
    for shot in shots:
        for (index, _), level in zip(rig.emitters, shot.levels.tolist(), strict=True):
            address = rig.lights[index].address
            if 0 < level < 1 and address is not None and not (address.protocol in DMX or rig.controllers.dims(address.protocol)):
                advice = "" if address.protocol == "manual" else f" (controllers.{address.protocol}.on has no field {{level}})"
                raise RequestError(f"the plan has {rig.lights[index].name} at {100 * level:.3g} % of its light for {shot.key}, and its "
                                   f"protocol {address.protocol} only switches{advice}: gradients and a level below 1 need lamps that are "
                                   "dimmed")


def _sequence(sequence: AnySequence, rig: Rig, projector: tuple[int, int] | None, where: str) -> Iterator[Shot]:
    """Yield the shots of a sequence, once for all exposures, without their numbers."""
    dark, full = np.zeros(len(rig.emitters)), even_levels(rig)
    match sequence:
        case OlatSequence():
            yield from _one_by_one(rig, _lamps(rig, sequence.lights, f"{where}.lights"), sequence.level, "")
        case BallSequence():
            yield from _one_by_one(rig, range(len(rig.lights)), 1.0, sequence.take)
        case GradientSequence():
            yield from _gradients(rig, sequence)
        case DarkSequence():
            for _ in range(sequence.count):
                yield Shot("dark", "", dark, light=OffLight(type="off"))
        case FlatSequence():
            yield Shot(FLAT, "", full)
        case ChartSequence():
            yield Shot("chart", "chart", full, light=FullLight(type="full"))
        case (PatternSequence() | ResponseSequence()) if projector is None:
            raise RequestError(f"{where}: shows patterns: give the pixels of the projector, --projector 1280x800")
        case ResponseSequence():
            for level in np.linspace(0, 1, sequence.levels).tolist():
                yield Shot("grey", sequence.take, dark, grey=level)
        case PatternSequence():
            assert projector is not None
            try:
                patterns = patterns_of(PatternsRequest(code=sequence.code, axis=sequence.axis, projector=projector, out=Path()))
            except ValueError as error:
                raise RequestError(f"{where}.code: {error}") from error
            for pattern in patterns:
                yield Shot("pattern", "", dark, pattern=pattern)


def _one_by_one(rig: Rig, lamps: Sequence[int], level: float, folder: str) -> Iterator[Shot]:
    """Yield a shot under each of some lamps alone."""
    for index in lamps:
        levels = np.array([level if lamp == index else 0.0 for lamp, _ in rig.emitters])
        yield Shot(f"light_{index + 1:03d}", folder, levels, lamp=index, light=_light_of(rig, index, level))


def _gradients(rig: Rig, sequence: GradientSequence) -> Iterator[Shot]:
    """Yield the six gradients and full light; a lamp in direction ω has the level (1 ± ω_axis) / 2."""
    direction = rig.directions[[lamp for lamp, _ in rig.emitters]]
    for column, axis in enumerate(AXES):
        for sign in (1, -1):
            light = GradientLight.model_validate({"type": "gradient", "axis": axis, "sign": sign, "polarization": sequence.polarization})
            yield Shot("gradient", "", (1 + sign * direction[:, column]) / 2, light=light)
    light = GradientLight(type="gradient", axis="full", polarization=sequence.polarization)
    yield Shot("gradient", "", np.ones(len(rig.emitters)), light=light)


def _light_of(rig: Rig, index: int, level: float) -> Light:
    """Return the entry `light` of a frame that a lamp alone lights, in the colour space of the rig."""
    lamp = rig.lights[index]
    irradiance = level * np.sum([primary.irradiance for primary in lamp.primaries], axis=0)
    if lamp.position_m is None:
        return DistantLight.model_validate({"type": "distant", "direction": lamp.direction, "irradiance": irradiance.tolist()})
    squared = float(np.sum(np.subtract(lamp.position_m, rig.subject_m) ** 2))  # the irradiance is that at the subject
    return PointLight.model_validate({"type": "point", "position_m": lamp.position_m, "intensity": (squared * irradiance).tolist()})


def _tracking(rig: Rig, sequence: OlatSequence | GradientSequence | PatternSequence) -> Shot:
    """Return a shot under full light, as a sequence has it, which shows whether something moved; white of a projector is no frame."""
    if isinstance(sequence, PatternSequence):
        return Shot(TRACKING, TRACKING, np.zeros(len(rig.emitters)), pattern=UniformPattern(code="white"))
    levels = even_levels(rig, sequence.level) if isinstance(sequence, OlatSequence) else np.ones(len(rig.emitters))
    return Shot(TRACKING, "", levels, light=FullLight(type="full"))


def even_levels(rig: Rig, level: float = 1.0) -> np.ndarray:
    """Return the levels [emitters] at which all lamps together light a surface about as one alone does at a level.

    Of lamps all around, a surface sees half, at a mean cosine of one half. Lamps that are only switched shine at full level.
    """
    dimmed = min(1.0, SEEN * level / max(1, len(rig.lights)))
    return np.array([dimmed if (address := rig.lights[index].address) is not None and address.protocol in DMX else 1.0
                     for index, _ in rig.emitters])


def _lamps(rig: Rig, names: Sequence[str] | None, where: str) -> Sequence[int]:
    if names is None:
        return range(len(rig.lights))
    known = {lamp.name: index for index, lamp in enumerate(rig.lights)}
    missing = [name for name in names if name not in known]
    if missing:
        raise RequestError(f"{where}: the rig {rig.name} has no lamp {missing[0]}: it has {rig.lights[0].name} to {rig.lights[-1].name}")
    return [known[name] for name in names]


def _named(shots: Sequence[Shot]) -> Iterator[Shot]:
    """Yield the shots with their number of all before their names, so that files lie in the order in which they were taken."""
    for number, shot in enumerate(shots, start=1):
        yield shot if shot.name == FLAT else shot._replace(name=f"{number:04d}_{shot.name}")
