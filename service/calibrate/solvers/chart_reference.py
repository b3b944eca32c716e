"""The colours of the patches of a colour chart: those of its maker, or of a file, CGATS or CSV.

Built in are the values that X-Rite published for charts made since November 2014 (`color_checker_24.csv`, `color_checker_sg.csv`): CIELAB
under D50 for the observer of 2 degrees. Older charts, and charts that have aged, differ by up to 2 in CIEDE2000.
"""

import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.calibrate.solvers.cielab import WHITES, adaptation, lab_from_xyz, xyz_from_lab, xyz_from_linear
from stage import inputs
from stage.errors import ManifestError
from stage.formats.csv_table import read_table

GRIDS = {24: (6, 4), 140: (14, 10)}
"""The columns and rows of the charts, by the number of their patches."""
COLUMNS = (("lab_l", "lab_a", "lab_b"), ("xyz_x", "xyz_y", "xyz_z"), ("r", "g", "b"))
"""The columns of CIELAB, of XYZ with a white of Y = 100, and of linear reflectances in the space of the capture."""
SHORT = {"l": "lab_l", "a": "lab_a", "l*": "lab_l", "a*": "lab_a", "b*": "lab_b", "x": "xyz_x", "y": "xyz_y", "z": "xyz_z"}
"""Names that columns of CSV files have for those of CGATS; b is that of CIELAB beside a."""
LEAST_WHITE = 2.0
"""The largest Y of a chart that is below this was given as a part of 1, and not of 100."""


class ChartReference(NamedTuple):
    """The patches of a chart in reading order."""

    names: tuple[str, ...]
    lab: np.ndarray  # [patches, 3] float64, CIELAB under D50
    source: str
    """Where the colours come from, for the report."""

    @property
    def grid(self) -> tuple[int, int]:
        """The columns and rows of the chart."""
        return GRIDS[len(self.names)]

    @property
    def xyz(self) -> np.ndarray:
        """The patches [patches, 3] as XYZ under D50."""
        return xyz_from_lab(self.lab, WHITES["D50"])

    def labels(self) -> list[str]:
        """Return each patch by its number and name."""
        return [f"patch {number} ({name})" for number, name in enumerate(self.names, start=1)]


def built_in(patches: int) -> ChartReference:
    """Return the published colours of the chart with 24 or with 140 patches."""
    path = Path(__file__).parent / f"color_checker_{'24' if patches == 24 else 'sg'}.csv"
    return read_reference(path, patches, "D50", "")._replace(source="X-Rite, November 2014, D50, 2 degrees")


def read_reference(
    path: Path,  # CGATS with LAB_L LAB_A LAB_B or XYZ_X XYZ_Y XYZ_Z, or CSV with the columns name and l, a, b or x, y, z or r, g, b
    patches: int,  # how many the chart has
    illuminant: str,  # D50 or D65, the light of colours whose file does not name it
    space: str,  # the scene-linear space of r, g, b
) -> ChartReference:
    """Read the colours of a chart from a file.
    Raises ManifestError if the file is none of these or has another number of patches; names the line or the column."""
    content = inputs.read_bytes(path)
    if b"BEGIN_DATA" in content:
        names, kind, values, named = _read_cgats(path, content.decode("utf-8", "replace"))
        illuminant = named or illuminant
    else:
        names, kind, values = _read_csv(path)
    if len(names) != patches:
        raise ManifestError(f"{path}: has {len(names)} patches, the chart has {patches}")
    white = WHITES[illuminant]
    if kind == "r":
        xyz, white = values @ xyz_from_linear(space).T, WHITES["D50"]
    elif kind == "lab_l":
        xyz = xyz_from_lab(values, white)
    else:
        if values[:, 1].max() < LEAST_WHITE:
            raise ManifestError(f"{path}: the largest Y is {values[:, 1].max():g}: give XYZ of which white has Y = 100")
        xyz = values / 100
    lab = lab_from_xyz(xyz @ adaptation(white, WHITES["D50"]).T, WHITES["D50"])
    light = "" if kind == "r" else f", {illuminant}"
    return _in_reading_order(ChartReference(tuple(names), lab, f"{path.name}{light}"))


def _read_csv(path: Path) -> tuple[list[str], str, np.ndarray]:
    rows = read_table(path, ["name"])
    heads = list(rows.fieldnames or ())
    short = SHORT | ({"b": "lab_b"} if "a" in heads else {})
    rows.fieldnames = heads = [short.get(head, head) for head in heads]
    columns = _columns(path, heads)
    found = [(row["name"] or "", [row[column] or "" for column in columns]) for row in rows]
    values = [_numbers(path, name, texts) for name, texts in found]
    return [name.strip() for name, _ in found], columns[0], np.array(values)


def _read_cgats(path: Path, text: str) -> tuple[list[str], str, np.ndarray, str | None]:
    parts = re.search(r"BEGIN_DATA_FORMAT\s(.*?)END_DATA_FORMAT.*?BEGIN_DATA\s(.*?)END_DATA", text, re.DOTALL)
    if parts is None:
        raise ManifestError(f"{path}: is no CGATS file: it needs BEGIN_DATA_FORMAT and BEGIN_DATA, each with its end")
    heads, words = parts[1].lower().split(), [word.strip('"') for word in re.findall(r'"[^"]*"|\S+', parts[2])]
    columns = _columns(path, heads)
    label = next((heads.index(name) for name in ("sample_name", "sample_id", "sampleid") if name in heads), None)
    if label is None or len(words) % len(heads):
        raise ManifestError(f"{path}: its data do not fit the columns {' '.join(heads)}, of which one must be SAMPLE_ID or SAMPLE_NAME")
    rows = [words[begin : begin + len(heads)] for begin in range(0, len(words), len(heads))]
    values = [_numbers(path, row[label], [row[heads.index(column)] for column in columns]) for row in rows]
    illuminants = set(re.findall(r"\bD\d\d\b", " ".join(line for line in text[: parts.start()].splitlines() if "ILLUM" in line.upper())))
    if strange := illuminants - set(WHITES):
        raise ManifestError(f"{path}: has colours under {min(strange)}: give them under {' or '.join(WHITES)}")
    return [row[label] for row in rows], columns[0], np.array(values), min(illuminants, default=None)


def _columns(path: Path, heads: list[str]) -> tuple[str, ...]:
    for columns in COLUMNS:
        if all(column in heads for column in columns):
            return columns
    raise ManifestError(f"{path}: has no colours: it needs the columns LAB_L LAB_A LAB_B or XYZ_X XYZ_Y XYZ_Z, in CSV also l,a,b or x,y,z "
                        "or r,g,b")


def _numbers(path: Path, name: str, texts: list[str]) -> list[float]:
    try:
        values = [float(text.replace(",", ".")) for text in texts]  # some tables have decimal commas
    except ValueError:
        values = []
    if not values or not np.isfinite(values).all():
        raise ManifestError(f"{path}: {name}: its colour {' '.join(texts)} must be three numbers")
    return values


def _in_reading_order(chart: ChartReference) -> ChartReference:
    """Return a chart whose patches are named as A1 is in reading order: letters are columns where there are as many, else rows."""
    places = [re.fullmatch(r"([A-Za-z])0*(\d+)", name) for name in chart.names]
    if not all(places):
        return chart
    letters = [ord(place[1].upper()) - ord("A") for place in places if place]
    numbers = [int(place[2]) - 1 for place in places if place]
    columns, rows = chart.grid
    by_column = max(letters) == columns - 1 and max(numbers) == rows - 1
    order = sorted(range(len(letters)), key=lambda each: (numbers[each], letters[each]) if by_column else (letters[each], numbers[each]))
    return chart._replace(names=tuple(chart.names[each] for each in order), lab=chart.lab[order])
