"""A sequence: captures of one camera, or results of them, one for each time step; `sequence.json` with schema relit.sequence/1."""

from collections.abc import Iterable
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, Self

from pydantic import Field, model_validator

from stage.capture.manifest import FILE_NAME, Manifest, read_manifest
from stage.errors import ManifestError, storage
from stage.files import write_text
from stage.folders import natural_order
from stage.model import FirstFault, NotNegative, Positive, Strict, Text
from stage.records import read_record

SEQUENCE_FILE = "sequence.json"
FRAME_RATE = 24.0
"""Steps per second where nobody says how many."""
ALIKE = (*(f"camera.{field}" for field in ("projection", "resolution", "focal_px", "principal_px", "distortion", "pixel_size_m",
                                            "surface_z_m", "world_from_camera")), "color_space", "irradiance_scale")
"""The fields of the manifest that the steps of a sequence share."""


class Step(Strict):
    """One time step."""

    path: Text
    """The folder of its capture or result, relative to the folder of the file."""
    time_s: NotNegative | None = None
    """Time at which it was taken, seconds; give it for every step or for none. None: its number over `frames_per_second`."""


class SequenceFile(Strict):
    """The content of sequence.json."""

    schema_: Literal["relit.sequence/1"] = Field(alias="schema")
    """The kind and version of the file."""
    frames_per_second: Positive = FRAME_RATE
    """Time codes a second of what is made of the sequence."""
    steps: Annotated[tuple[Step, ...], Field(min_length=1), FirstFault]
    """The time steps in their order."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        given = [step.time_s is not None for step in self.steps]
        if any(given) and not all(given):
            raise ValueError(f"steps[{given.index(False)}].time_s: is missing: give it for every step or for none")
        for number, (one, other) in enumerate(pairwise(self.steps), start=1):
            if one.time_s is not None and other.time_s is not None and other.time_s <= one.time_s:
                raise ValueError(f"steps[{number}].time_s: is {other.time_s:g}, the step before has {one.time_s:g}: give steps in order of "
                                 "time")
        names = [Path(step.path).name for step in self.steps]
        for number, name in enumerate(names):
            if name in ("", ".."):
                raise ValueError(f"steps[{number}].path: is {self.steps[number].path}: name the folder, after which results are named")
            if names.index(name) != number:
                raise ValueError(f"steps[{number}].path: ends in {name} as that of steps[{names.index(name)}]: results are named after it")
        return self


class TimeStep(NamedTuple):
    """One step of a sequence that was found."""

    name: str
    folder: Path
    time_s: float


class Sequence(NamedTuple):
    """The steps of a sequence and their rate."""

    steps: tuple[TimeStep, ...]
    frames_per_second: float
    timed: bool
    """True if a file says the rate and times; else the steps are folders in order of name."""

    def step(self, number: int, path: Path) -> TimeStep:
        """Return the step of a number, from 1, of a sequence that was checked before."""
        if number > len(self.steps):
            raise ManifestError(f"{path}: has {len(self.steps)} steps now, and had more when it was checked")
        return self.steps[number - 1]


class Difference(NamedTuple):
    """A field in which two manifests differ, with both values as text."""

    field: str
    value: str
    other: str


def is_sequence(path: Path) -> bool:
    """Return whether a path is a sequence of captures: its sequence.json, its folder, or a folder of captures without a capture.json."""
    with storage("read", path):
        if path.is_file():
            return path.suffix.lower() == ".json" and path.name != FILE_NAME
        if not path.is_dir() or (path / FILE_NAME).exists():
            return False
        return (path / SEQUENCE_FILE).is_file() or bool(capture_folders(path))


def capture_folders(folder: Path) -> list[Path]:
    """Return the folders in a folder that hold a capture, in order of name: 2 before 10."""
    with storage("read", folder):
        return [folder / name for name in natural_order(inside.name for inside in folder.iterdir() if (inside / FILE_NAME).is_file())]


def read_sequence(path: Path, *, frames_per_second: float | None = None) -> Sequence:
    """Return the steps of a sequence of captures or results.
    `path`: a sequence.json, its folder, or a folder of captures. `frames_per_second`: of a folder of captures; a file says its own."""
    file = path if path.is_file() else path / SEQUENCE_FILE
    if not file.is_file():
        rate = frames_per_second or FRAME_RATE
        folders = capture_folders(path)
        return Sequence(tuple(TimeStep(folder.name, folder, number / rate) for number, folder in enumerate(folders)), rate, False)
    found = read_record(file, SequenceFile)
    if frames_per_second not in (None, found.frames_per_second):
        raise ManifestError(f"{file}: frames_per_second: is {found.frames_per_second:g}, --frame-rate {frames_per_second:g}: leave one out")
    rate = found.frames_per_second
    steps = (TimeStep(Path(step.path).name, file.parent / step.path, number / rate if step.time_s is None else step.time_s)
             for number, step in enumerate(found.steps))
    return Sequence(tuple(steps), rate, True)


def write_sequence(sequence: Sequence, path: Path) -> None:
    """Write a sequence.json whose steps are the folders of their names beside it."""
    content = SequenceFile(schema="relit.sequence/1", frames_per_second=sequence.frames_per_second,
                           steps=tuple(Step(path=step.name, time_s=step.time_s) for step in sequence.steps))
    write_text(path, content.model_dump_json(by_alias=True, indent=2) + "\n")


def check_alike(sequence: Sequence) -> list[Manifest]:
    """Check that the captures of a sequence are of one camera, colour space and scale of light, and return their manifests."""
    manifests = []
    for step in sequence.steps:
        if not (step.folder / FILE_NAME).is_file():
            raise ManifestError(f"{step.folder}: holds no {FILE_NAME}: every step of a sequence is a capture")
        manifests.append(read_manifest(step.folder / FILE_NAME))
    first = manifests[0]
    for step, manifest in zip(sequence.steps, manifests, strict=True):
        if (apart := difference(manifest, first, ALIKE)) is not None:
            raise ManifestError(f"{step.folder / FILE_NAME}: {apart.field}: is {apart.value}, that of {sequence.steps[0].name} "
                                f"{apart.other}: the steps of a sequence are of one camera, colour space and scale of light")
    return manifests


def difference(manifest: Manifest, other: Manifest, fields: Iterable[str]) -> Difference | None:
    """Return the first of some fields in which two manifests differ, or None."""
    for field in fields:
        value, there = attrgetter(field)(manifest), attrgetter(field)(other)
        if value != there:
            return Difference(field, _shown(value), _shown(there))
    return None


def _shown(value: object) -> str:
    return "x".join(map(str, value)) if isinstance(value, tuple) and len(value) == 2 else "missing" if value is None else str(value)
