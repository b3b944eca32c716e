"""The plan of a capture, plan.json with schema relit.plan/1: the sequences of pictures that are taken one after another."""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from service.errors import RequestError
from service.requests.acquire import PlanChoices
from service.requests.patterns import PatternAxis, PatternCode
from stage.capture.light import Polarization
from stage.model import Count, FirstFault, Fraction, NotNegative, Positive, Strict, Text
from stage.records import read_record


class Sequence(Strict):
    """The fields of every sequence of pictures."""

    prompt: Text | None = None
    """What a person does before the first picture, such as placing a card: the pictures wait until it is confirmed. None: nothing."""
    exposures_s: Annotated[tuple[Positive, ...], FirstFault] = ()
    """The exposure times of each picture, one after another; none: the one that the camera has."""


class OlatSequence(Sequence):
    """One picture under each lamp alone."""

    take: Literal["olat"]
    """The kind of the sequence."""
    lights: Annotated[tuple[Text, ...], FirstFault] | None = None
    """The names of the lamps; None: all lamps of the rig."""
    level: Annotated[Fraction, Field(gt=0)] = 1.0
    """The light of each lamp, a fraction of that at full level, of all its primaries alike."""


class GradientSequence(Sequence):
    """Pictures under spherical gradients along x, y and z, rising and falling, and under full light (Ma et al. 2007)."""

    take: Literal["gradients"]
    """The kind of the sequence."""
    polarization: Polarization = "none"
    """How the polariser of the camera stands to those of the lamps during the sequence."""


class DarkSequence(Sequence):
    """Pictures without any lamp, which are subtracted from the others."""

    take: Literal["dark"]
    """The kind of the sequence."""
    count: Count = 1
    """Number of pictures."""


class FlatSequence(Sequence):
    """A picture of an evenly lit white card under all lamps, by which the others are divided."""

    take: Literal["flat"]
    """The kind of the sequence."""


class BallSequence(Sequence):
    """A picture of a ball under each lamp alone, in a capture of its own, in the folder of its kind, for `relit calibrate lights`."""

    take: Literal["mirror-ball", "grey-ball"]
    """The kind of the sequence."""


class ChartSequence(Sequence):
    """A picture of a colour chart under all lamps, in a capture of its own, in the folder chart."""

    take: Literal["chart"]
    """The kind of the sequence."""


class PatternSequence(Sequence):
    """Pictures of patterns that a projector shows."""

    take: Literal["patterns"]
    """The kind of the sequence."""
    code: PatternCode
    """The code, as `relit patterns` has it, with its default options."""
    axis: PatternAxis = PatternAxis.COLUMN
    """The projector coordinate to code."""


class ResponseSequence(Sequence):
    """Pictures of even grey that a projector shows, which measure its response: the patterns after them are shown in linear light."""

    take: Literal["projector-response"]
    """The kind of the sequence."""
    levels: Annotated[int, Field(ge=3, le=256)] = 17
    """Number of levels, at even distances from black to full."""


AnySequence = Annotated[OlatSequence | GradientSequence | DarkSequence | FlatSequence | BallSequence | ChartSequence | PatternSequence
                        | ResponseSequence, Field(discriminator="take")]


class Plan(Strict):
    """The content of a plan."""

    schema_: Literal["relit.plan/1"] = Field(alias="schema")
    """The kind and version of the file."""
    sequences: Annotated[tuple[AnySequence, ...], Field(min_length=1), FirstFault]
    """The sequences, in the order in which they are taken."""
    settle_s: NotNegative = 0.1
    """The time between a change of the lamps or the pattern and the picture."""
    tracking_every: Count | None = None
    """A picture under full light is taken before every so many pictures of lamps, one of white before every so many patterns, and each
    after the last; None: none."""


_WHITE_CARD = "put a white card in the place of the object, and let it fill the picture"
NAMED: dict[str, tuple[AnySequence, ...]] = {
    "olat": (OlatSequence(take="olat"),),
    "gradients": (GradientSequence(take="gradients"),),
    "polarised": (
        GradientSequence(take="gradients", polarization="parallel", prompt="turn the camera's polariser parallel to those of the lamps"),
        GradientSequence(take="gradients", polarization="cross", prompt="turn the camera's polariser across those of the lamps")),
    "dark": (DarkSequence(take="dark"),),
    "flat": (FlatSequence(take="flat", prompt=_WHITE_CARD),),
    "mirror-ball": (BallSequence(take="mirror-ball", prompt="put the mirror ball in the place of the object"),),
    "grey-ball": (BallSequence(take="grey-ball", prompt="put the grey ball in the place of the object"),),
    "chart": (ChartSequence(take="chart", prompt="put the colour chart in the place of the object"),),
    "projector-response": (ResponseSequence(take="projector-response"),),
    **{str(code): (PatternSequence(take="patterns", code=code),) for code in PatternCode},
}
"""The sequences that a name stands for."""
_EXPOSED = OlatSequence | GradientSequence | DarkSequence | PatternSequence
"""The sequences of which the frames of one capture come."""


def needs_projector(sequences: Iterable[AnySequence]) -> bool:
    """Return whether one of some sequences is shown by a projector."""
    return any(isinstance(sequence, PatternSequence | ResponseSequence) for sequence in sequences)


def read_plan(given: str) -> Plan:
    """Return the plan of a file, or of names with commas between them, such as dark,olat.
    Raises RequestError if it names neither a file nor a known sequence. Raises ManifestError if the file is wrong; names file and field."""
    if Path(given).suffix == ".json" or Path(given).is_file():
        return read_record(given, Plan)
    names = given.split(",")
    unknown = [name for name in names if name not in NAMED]
    if unknown:
        raise RequestError(f"the plan {given}: {unknown[0]} is neither a file nor one of {', '.join(NAMED)}")
    return Plan(schema="relit.plan/1", sequences=tuple(sequence for name in names for sequence in NAMED[name]))


def plan_of(chosen: PlanChoices) -> Plan:
    """Return the plan that was chosen: exposure times are those of all pictures that make one capture.
    Raises RequestError if a name is none of a sequence, or lamps are chosen where none is lit by itself."""
    changed, sequences = [], read_plan(chosen.plan).sequences
    if chosen.lights is not None and not any(isinstance(sequence, OlatSequence) for sequence in sequences):
        raise RequestError(f"lights: {chosen.plan} lights no lamps one by one: add olat, or choose no lamps")
    for sequence in sequences:
        exposed = {"exposures_s": chosen.exposures_s} if isinstance(sequence, _EXPOSED) else {}
        lit = {"lights": chosen.lights} if isinstance(sequence, OlatSequence) else {}
        changed.append(sequence.model_copy(update={**exposed, **lit}))
    return Plan(schema="relit.plan/1", sequences=tuple(changed), tracking_every=chosen.tracking_every)


def choices_of(plan: Plan) -> PlanChoices | None:
    """Return the choices of which a plan is made; None: it has something of its own."""
    names: list[str] = []
    exposures: tuple[float, ...] = next((each.exposures_s for each in plan.sequences if isinstance(each, _EXPOSED)), ())
    lights = next((each.lights for each in plan.sequences if isinstance(each, OlatSequence)), None)
    left = [each.model_copy(update={"exposures_s": (), **({"lights": None} if isinstance(each, OlatSequence) else {})})
            for each in plan.sequences]
    while left:
        name = next((name for name, named in NAMED.items() if tuple(left[:len(named)]) == named), None)
        if name is None:
            return None
        names.append(name)
        left = left[len(NAMED[name]):]
    chosen = PlanChoices(plan=",".join(names), exposures_s=exposures, tracking_every=plan.tracking_every, lights=lights)
    return chosen if plan_of(chosen) == plan else None
