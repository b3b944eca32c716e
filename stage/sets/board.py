"""The JSON files of board inspection: which tiles a board was measured in, and what a board should be."""

from itertools import pairwise
from pathlib import PurePosixPath
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from stage.model import Count, Finite, FirstFault, Fraction, NotNegative, Positive, Strict, Text

SCAN_FILE = "board.json"
Place = tuple[Finite, Finite]
"""x and y in metres, board frame."""


def _within(name: str) -> str:
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
        raise ValueError(f"{name} leads out of the folder of the file: give a path within it")
    return name


Beneath = Annotated[Text, AfterValidator(_within)]
"""A path relative to the file that names it, which does not lead out of the file's folder."""


class Tile(Strict):
    """One tile: a folder with a depth.exr or with a capture.json."""

    path: Beneath
    """The folder, relative to the file."""
    position_m: Place | tuple[Finite, Finite, Finite] | None = None
    """Where the stage held the camera: it then looks along -z of the board frame, upright. None: `world_from_camera` of its manifest."""


class BoardScan(Strict):
    """The tiles of a board (schema relit.board-scan/1)."""

    schema_: Literal["relit.board-scan/1"] = Field(alias="schema")
    name: Text
    stage_sigma_m: Positive | None = None
    """Standard deviation of a stage position along x and y, metres. None: 5 pixels."""
    stage_sigma_degrees: NotNegative | None = None
    """Standard deviation of the rotation of a tile about z, degrees. None: 0.1."""
    tiles: Annotated[tuple[Tile, ...], Field(min_length=1), FirstFault]

    @model_validator(mode="after")
    def _check(self) -> Self:
        paths = [tile.path for tile in self.tiles]
        twice = next((path for at, path in enumerate(paths) if path in paths[:at]), None)
        if twice is not None:
            raise ValueError(f"tiles: {twice} is given twice")
        return self


class Region(Strict):
    """A part of a board whose mean height must lie within a tolerance of the nominal one."""

    name: Text
    shape: Literal["rectangle", "circle"]
    centre_m: Place
    """Board frame of the nominal height map."""
    size_m: tuple[Positive, Positive]
    """Width and height; of a circle the diameter, twice."""
    tolerance_m: tuple[Finite, Finite]
    """The least and the largest deviation of the mean height, metres."""
    least_inspected: Fraction | None = None
    """The least part of its pixels that must be measured; below, the region is not inspected. None: as `--least-inspected` says."""
    datum: Literal["board", "surround"] = "board"
    """Against what heights count: the plane of the whole board, or the mean of the ring of half the region's size around it."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.tolerance_m[0] >= self.tolerance_m[1]:
            raise ValueError("tolerance_m: the least deviation must be smaller than the largest")
        if self.shape == "circle" and self.size_m[0] != self.size_m[1]:
            raise ValueError("size_m: must be the diameter of the circle, twice")
        return self


def _named_once(regions: tuple[Region, ...]) -> tuple[Region, ...]:
    names = sorted(region.name for region in regions)
    twice = next((name for name, after in pairwise(names) if name == after), None)
    if twice is not None:
        raise ValueError(f"the name {twice} is given twice")
    return regions


NamedOnce = AfterValidator(_named_once)


class BoardRegions(Strict):
    """The regions of a golden board (schema relit.board-regions/1): those of a design, without its height map."""

    schema_: Literal["relit.board-regions/1"] = Field(alias="schema")
    regions: Annotated[tuple[Region, ...], Field(min_length=1), FirstFault, NamedOnce]


class NominalMap(Strict):
    """The nominal height map of a design."""

    path: Beneath
    """An EXR with height.Z in metres, relative to the file; NaN, or mask.Y 0, where nothing is nominal. sigma.Z, if there, is its
    standard deviation."""
    resolution: tuple[Count, Count]
    """Width and height in pixels."""
    pixel_m: Positive
    top_left_m: Place
    """Board-frame x and y of the upper left corner of its first pixel."""


class BoardDesign(Strict):
    """Nominal heights and tolerance regions of a board (schema relit.board-design/1)."""

    schema_: Literal["relit.board-design/1"] = Field(alias="schema")
    name: Text
    height_map: NominalMap
    regions: Annotated[tuple[Region, ...], FirstFault, NamedOnce] = ()


class GaugeRun(Strict):
    """One inspection of one board by one operator."""

    result: Beneath
    """The result folder of relit inspect-board with regions, relative to the file; in a job of the service, the job that inspected."""
    board: Text
    operator: Text = "operator"
    """The person or station that measured."""


class GaugeRuns(Strict):
    """The inspections of a gauge study (schema relit.gauge-study/1): every operator measures every board as often."""

    schema_: Literal["relit.gauge-study/1"] = Field(alias="schema")
    name: Text
    runs: Annotated[tuple[GaugeRun, ...], Field(min_length=2), FirstFault]

    @model_validator(mode="after")
    def _check(self) -> Self:
        results = [run.result for run in self.runs]
        twice = next((result for at, result in enumerate(results) if result in results[:at]), None)
        if twice is not None:
            raise ValueError(f"runs: the result {twice} is given twice")
        return self
