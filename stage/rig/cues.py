"""The file of cues, cues.json with schema relit.cues/1: the level of every primary of a rig in every frame, and the DMX values for it."""

import hashlib
import json
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from stage.errors import ManifestError
from stage.files import write_text
from stage.model import FirstFault, Fraction, Positive, Strict, Text
from stage.records import read_record
from stage.rig.rig import CHANNELS, Rig

CUES_FILE = "cues.json"


class UniverseCue(Strict):
    """The values of one universe in one frame."""

    protocol: Literal["sacn", "artnet"]
    """The protocol that carries the universe."""
    universe: int
    """The number of the universe."""
    values: Annotated[tuple[Annotated[int, Field(ge=0, le=255)], ...], Field(min_length=CHANNELS, max_length=CHANNELS), FirstFault]
    """The values of its 512 channels."""


class FrameCue(Strict):
    """The lamps in one frame."""

    frame: Annotated[int, Field(ge=0)]
    """The number of the frame."""
    levels: Annotated[tuple[Fraction, ...], FirstFault]
    """The light of each emitter, a fraction of that at full level, in the order of `emitters`."""
    dmx: Annotated[tuple[UniverseCue, ...], FirstFault] = ()
    """The values of each universe."""


class Cues(Strict):
    """The content of a file of cues."""

    schema_: Literal["relit.cues/1"] = Field(alias="schema")
    """The kind and version of the file."""
    rig: Text
    """The name of the rig."""
    rig_digest: Text
    """The digest of the rig's lamps and addresses, by which cues of another rig are refused."""
    frames_per_second: Positive
    """Frames per second."""
    emitters: Annotated[tuple[tuple[Text, Text], ...], FirstFault]
    """The lamp and the primary of each level."""
    frames: Annotated[tuple[FrameCue, ...], Field(min_length=1), FirstFault]
    """The frames, in order."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        for index, frame in enumerate(self.frames):
            if len(frame.levels) != len(self.emitters):
                raise ValueError(f"frames[{index}].levels: has {len(frame.levels)} entries, emitters has {len(self.emitters)}")
        return self

    @property
    def levels(self) -> np.ndarray:
        """Return the levels [frames, emitters] float64."""
        return np.array([frame.levels for frame in self.frames])


def rig_digest(rig: Rig) -> str:
    """Return the digest of what the levels of a rig depend on: its lamps, their places, primaries and addresses."""
    content = [lamp.model_dump(mode="json") for lamp in rig.lights]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def read_cues(path: str | Path, rig: Rig) -> Cues:
    """Read the cues of a rig, from their file or from the folder that holds cues.json.
    Raises ManifestError if the file is wrong, or was made for another rig; names the file and the field."""
    path = Path(path)
    path = path / CUES_FILE if path.is_dir() else path
    cues = read_record(path, Cues)
    if cues.rig_digest != rig_digest(rig):
        raise ManifestError(f"{path}: rig_digest: the cues were made for another rig, or for {cues.rig} before its lamps were changed: "
                            "run relit drive again")
    return cues


def write_cues(cues: Cues, path: str | Path) -> None:
    """Write a file of cues whole or not at all, a line for each frame."""
    data = cues.model_dump(mode="json", by_alias=True)
    frames = ",\n".join("    " + json.dumps(frame) for frame in data.pop("frames"))
    write_text(path, json.dumps(data)[:-1] + f',\n"frames": [\n{frames}\n]}}\n')
