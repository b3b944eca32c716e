"""The faults that a picture can have."""

from collections.abc import Sequence
from typing import NamedTuple

from service.requests.base.base import Choice


class FaultKind(Choice):
    """What is wrong with a picture."""

    CLIPPED = "clipped", "too many readings of the object are at full scale"
    DARK = "too_dark", "the brightest readings are near the noise"
    UNLIT = "did_not_light", "the light did not come on"
    WRONG_LIGHT = "wrong_light", "another light shone than the plan says"
    DOUBLED = "doubled", "the picture is one that was taken before"
    MISSING = "missing", "no picture came"
    LATE = "late", "a picture came when none was asked for"
    MOVED = "moved", "the object or the camera moved"
    UNSHARP = "focus", "the focus fell off"
    AMBIENT = "ambient", "light that is not the rig's changed"


class Fault(NamedTuple):
    """A fault of the picture of one shot."""

    shot: str
    """The key of the shot."""
    kind: FaultKind
    sentence: str
    """What was found, with its figures."""


def said(faults: Sequence[Fault]) -> dict[str, list[list[str]]]:
    """Return what a line of the journal says of the faults of a picture."""
    return {"faults": [[str(fault.kind), fault.sentence] for fault in faults]} if faults else {}
