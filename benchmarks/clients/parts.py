"""The figures of docs/asset_viewers.md: assets of path-traced captures, opened in every program and compared with the path tracer.

Each capture is a folder of samples/make_parts.py: metal and paint in parts that stand in front of each other, with the pictures under two
environments. Four assets are opened: of the solved maps and of the true ones, each exported by relit and written by
`benchmarks.clients.by_hand`. The last is the floor: what is left when maps and materials are right.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.clients.by_hand import write_by_hand
from benchmarks.clients.comparison import Comparison, compare
from benchmarks.clients.render import Client, Environment, render
from benchmarks.relighting import rgb
from service.export.export import export
from service.relight.sheet import display, write_sheet
from service.requests.export import ExportRequest
from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.capture.capture import Capture
from stage.formats import exr
from stage.results.maps import MAPS_FILE, SurfaceMaps

ENVIRONMENTS = {"A": "sky", "B": "patches"}
"""A: sun of 3° and sky; B: three soft patches."""
ASSETS = {"exported": "solved maps, as exported", "hand": "solved maps, written by hand", "true": "true maps, as exported",
          "floor": "true maps, written by hand (floor)"}
SAMPLES = 128
WHITE_PERCENTILE = 97
"""The value of the truth that is shown as 1."""
COLOR_SPACE = "lin_rec709_scene"


class Row(NamedTuple):
    """One asset in one program."""

    asset: str
    client: Client
    figures: dict[str, Comparison]
    """By environment."""


def true_maps(capture: Path) -> tuple[SurfaceMaps, np.ndarray | None]:
    """Return truth.exr as maps with parts, and the share of metal [rows, cols], where the file has it."""
    layers, _ = exr.read(capture / "truth.exr")

    def layer(name: str, suffixes: str) -> np.ndarray:
        return np.stack([layers[f"{name}.{each}"].astype(np.float32) for each in suffixes], axis=-1)

    opened = Capture.open(capture)
    part = layers["part.Y"].astype(np.uint8) if "part.Y" in layers else None
    maps = SurfaceMaps(camera=opened.manifest.camera, mask=opened.mask(), normal=layer("normal", "XYZ"),
                       diffuse_albedo=layer("diffuse_albedo", "RGB"), specular=layer("specular", "RGB"),
                       roughness=layer("roughness", "Y")[..., 0], height=layer("height", "Z")[..., 0], part=part)
    return maps, layers.get("metal.Y")


def make_assets(capture: Path, work: Path, solved: Path | None, wanted: tuple[str, ...] = tuple(ASSETS)) -> dict[str, Path]:
    """Write the assets of a capture.

    Args:
        capture: folder.
        work: for results.
        solved: folder with maps.exr; None: solve the capture.
        wanted: keys of ASSETS.

    Returns:
        The .usdz files by key.
    """
    work.mkdir(parents=True, exist_ok=True)
    if solved is None:
        solved = work / "maps"
        if not (solved / MAPS_FILE).exists():
            solve(SolveRequest(capture=capture, out=solved, method=Method.SVBRDF, cache=work))
    truth, metal = true_maps(capture)
    (work / "true").mkdir(exist_ok=True)
    truth.write(work / "true" / MAPS_FILE)
    made: dict[str, Path] = {}
    for key in wanted:
        made[key] = work / f"{key}.usdz"
        if key == "hand":
            write_by_hand(SurfaceMaps.read(solved / MAPS_FILE), work, key)
        elif key == "floor":
            write_by_hand(truth, work, key, metal)
        else:
            export(ExportRequest(maps=solved if key == "exported" else work / "true", out=made[key], name=key))
    return made


def measure(capture: Path, assets: dict[str, Path], clients: tuple[Client, ...], *, pictures: Path | None = None,
            samples: int = SAMPLES) -> Iterator[Row]:
    """Render every asset in every program under both environments, and yield the rows of the table.

    Args:
        capture: folder.
        assets: files by key.
        clients: the programs.
        pictures: folder for the renders as <asset>_<client>_<environment>.exr, or None.
        samples: paths of a pixel.
    """
    opened = Capture.open(capture)
    mask, metal = opened.mask(), true_maps(capture)[1]
    for key, asset in assets.items():
        for client in clients:
            figures = {}
            for letter, name in ENVIRONMENTS.items():
                light = Environment(rgb(capture / f"{name}_environment.exr"))
                picture = render(client, asset, opened.manifest.camera, light, samples=samples)
                figures[letter] = compare(picture, rgb(capture / f"{name}.exr"), mask, metal)
                if pictures is not None:
                    exr.write(pictures / f"{key}_{client}_{letter}.exr", dict(zip("RGBA", np.moveaxis(picture, -1, 0), strict=True)),
                              color_space=COLOR_SPACE, metadata={})
            yield Row(key, client, figures)


def table(name: str, rows: list[Row]) -> list[str]:
    """Return the rows as lines of Markdown."""
    lines = [f"| {name} | client | RMSE A, B | energy of metals A, B | of dielectrics A, B | scale A, B |", "|---" * 6 + "|"]
    for row in rows:
        cells = [", ".join(_number(getattr(each, key)) for each in row.figures.values())
                 for key in ("rmse", "metal", "dielectric", "scale")]
        lines.append(f"| {ASSETS[row.asset]} | {row.client} | {' | '.join(cells)} |")
    return lines


def write_picture(capture: Path, pictures: Path, key: str, clients: tuple[Client, ...], out: Path) -> None:
    """Write a sheet: one row for each environment; the truth, then each program's picture."""
    rows = []
    for letter, name in ENVIRONMENTS.items():
        truth = rgb(capture / f"{name}.exr")
        white = np.percentile(truth[Capture.open(capture).mask()], WHITE_PERCENTILE)
        shown = {"path-traced truth": truth} | {str(client): rgb(pictures / f"{key}_{client}_{letter}.exr") for client in clients}
        rows.append([(f"{title}, {letter}", display((image / white).astype(np.float32), COLOR_SPACE)) for title, image in shown.items()])
    write_sheet(out, rows)


def _number(value: float) -> str:
    return re.sub(r"^(-?)0\.", r"\1.", f"{value:.3f}")
