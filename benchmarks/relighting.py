"""Relit and shaded pictures against the path tracer: captured images alone, guided by solved maps, and the maps alone."""

import json
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.accuracy import SAMPLES
from service.relight.relight import relight
from service.relight.shade import shade
from service.relight.sheet import display, write_sheet
from service.requests.relight import LightWeights, RelightRequest
from service.requests.shade import ShadeRequest
from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.capture.capture import Capture
from stage.formats import exr
from stage.results.maps import MAPS_FILE, SurfaceMaps

PICTURE = Path(__file__).parents[1] / "docs" / "relighting.png"
GAIN = 4.0
"""The factor by which differences are shown brighter."""
OBJECTS = ("glossy", "owl", "two_parts", "figure", "still", "desk", "carved", "atelier")


class Check(NamedTuple):
    """A capture with path-traced reference images of the same object."""

    name: str
    folder: Path
    maps: Path
    """Solved from the capture."""
    work: Path
    """For caches and frames."""

    @property
    def mask(self) -> np.ndarray:
        """The mask of the capture, [rows, cols] bool."""
        return Capture.open(self.folder).mask()


def rgb(path: Path) -> np.ndarray:
    """Return an image as [rows, cols, 3] float64."""
    channels, _ = exr.read(path)
    return np.stack([channels[c] for c in "RGB"], axis=-1).astype(np.float64)


def error(ours: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> tuple[float, float]:
    """Return the relative RMSE over the mask, and the ratio of the total energies."""
    a, b = ours[mask], truth[mask]
    return float(np.sqrt(np.mean((a - b) ** 2) / np.mean(b**2))), float(a.sum() / b.sum())


def relit(check: Check, environment: Path, weights: LightWeights | None, maps: Path | None) -> np.ndarray:
    """Return a relit image."""
    result = relight(RelightRequest(capture=check.folder, environment=environment, weights=weights, maps=maps, cache=check.work,
                                    out=str(check.work / "frame.####.exr"), overwrite=True))
    return rgb(result.frames[0])


def shaded(check: Check, light: dict[str, Any], *, maps: Path, guided: bool) -> np.ndarray:
    """Return the image under one near light of references.json."""
    kinds = {"point": "light", "sphere": "sphere", "rectangle": "rectangle"}
    given = {key: value for key, value in light.items() if key not in ("type", "normal")}
    out = check.work / "shaded.exr"
    shade(ShadeRequest.model_validate({"maps": maps, "out": out, kinds[light["type"]]: [given], "cache": check.work,
                                       "capture": check.folder if guided else None}))
    return rgb(out)


def true_maps(check: Check) -> Path:
    """Write a maps.exr of the truth and return its path."""
    solved = SurfaceMaps.read(check.maps / MAPS_FILE)
    channels, _ = exr.read(check.folder / "truth.exr")

    def layer(name: str, suffixes: str) -> np.ndarray:
        return np.stack([channels[f"{name}.{s}"].astype(np.float32) for s in suffixes], axis=-1)

    folder = check.work / "true"
    folder.mkdir(exist_ok=True)
    SurfaceMaps(camera=solved.camera, mask=check.mask, normal=layer("normal", "XYZ"), diffuse_albedo=layer("diffuse_albedo", "RGB"),
                specular=layer("specular", "RGB"), roughness=layer("roughness", "Y")[..., 0], height=layer("height", "Z")[..., 0],
                part=layer("part", "Y")[..., 0].astype(np.uint8) if "part.Y" in channels else None,
                provenance=solved.provenance).write(folder / MAPS_FILE)
    return folder


def open_check(name: str, folder: Path, work: Path) -> Check:
    """Solve a capture for the check."""
    work.mkdir(parents=True, exist_ok=True)
    solve(SolveRequest(capture=folder, out=work / "maps", method=Method.SVBRDF, cache=work))
    return Check(name, folder, work / "maps", work)


def relighting_table(checks: Path | None) -> list[str]:
    """Return the table as lines of Markdown, and write docs/relighting.png when there are checks.

    Args:
        checks: folder with glossy and owl of samples/make_relight_checks.py, and those of samples/make_parts.py, as far as they are
            there; None: the shipped sample alone.
    """
    lines = ["Relative RMSE over the object, and total energy divided by that of the truth. `--maps`: guided by maps that `svbrdf` "
             "solved from the same capture.", "",
             "| | `--weights cells` | `--weights smooth` | `--weights kernel` | `--maps` |", "|---|---|---|---|---|"]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        scenes = [(open_check("owl", SAMPLES / "owl", Path(folder) / "sample"), "`samples/owl`, 96 lights, sun of 3° and sky",
                   "environment.exr", "reference_environment.exr")]
        for name in OBJECTS:
            if checks is None or not (checks / name).is_dir():
                continue
            check = open_check(name, checks / name, Path(folder) / name)
            scenes += [(check, f"{name}, 128 lights, {what}", f"{key}_environment.exr", f"{key}.exr")
                       for key, what in (("sky", "sun of 3° and sky"), ("patches", "three soft patches"))]
        for check, title, environment, reference in scenes:
            truth, mask = rgb(check.folder / reference), check.mask
            pictures = [relit(check, check.folder / environment, weights, maps) for weights, maps in
                        ((LightWeights.CELLS, None), (LightWeights.SMOOTH, None), (LightWeights.KERNEL, None),
                         (None, check.maps))]
            cells = [f"{rmse:.3f}, {energy:.3f}" for rmse, energy in (error(picture, truth, mask) for picture in pictures)]
            lines.append(f"| {title} | " + " | ".join(cells) + " |")
            under = environment.removesuffix(".exr").removesuffix("_environment")
            rows.append(_row(f"{check.name}, {under}: path traced", truth, pictures[2], pictures[3], mask))
        if checks:
            lines += ["", *_near_lines({check.name: check for check, *_ in scenes[1:]})]
            write_sheet(PICTURE, rows, height=220)
    return lines


def _near_lines(checks: dict[str, Check]) -> list[str]:
    lines = ["Near and area lights: `relit shade` with solved maps, compared with the path tracer with all bounces. In the last column "
             "true maps are compared; its `median` is that of the relative difference from direct light alone, over pixels brighter than a "
             "twentieth of the mean. Maps hold one normal a pixel, and no sheen, coat or anisotropy (`atelier`).", "",
             "| | maps alone | with `--capture` | true maps, direct light: RMSE, median |", "|---|---|---|---|"]
    for name, check in checks.items():
        truth_maps, mask = true_maps(check), check.mask
        references = {entry["file"]: entry["light"] for entry in json.loads((check.folder / "references.json").read_text())["references"]}
        for full, direct, what in (("near.exr", "near_direct.exr", "point light at 1.3 radii"),
                                   ("sphere_light_full.exr", "sphere_light.exr", "sphere light"),
                                   ("rectangle_light_full.exr", "rectangle_light.exr", "rectangle light")):
            truth = rgb(check.folder / full)
            cells = []
            for guided in (False, True):
                rmse, energy = error(shaded(check, references[full], maps=check.maps, guided=guided), truth, mask)
                cells.append(f"{rmse:.3f}, {energy:.3f}")
            ours, truth = shaded(check, references[direct], maps=truth_maps, guided=False), rgb(check.folder / direct)
            level = truth.mean(axis=-1)
            lit = mask & (level > 0.05 * level[mask].mean())
            median = np.median(np.abs(ours - truth).mean(axis=-1)[lit] / level[lit])
            lines.append(f"| {name}, {what} | " + " | ".join(cells) + f" | {error(ours, truth, mask)[0]:.3f}, {100 * median:.2g} % |")
    return lines


def _row(title: str, truth: np.ndarray, plain: np.ndarray, guided: np.ndarray, mask: np.ndarray) -> list[tuple[str, np.ndarray]]:
    exposure = 0.8 / np.percentile(truth[mask].mean(axis=-1), 99)

    def shown(picture: np.ndarray) -> np.ndarray:
        return display((picture * exposure).astype(np.float32), "lin_rec709_scene")

    return [(title, shown(truth)), ("captured lights alone", shown(plain)), (f"difference × {GAIN:g}", shown(GAIN * np.abs(plain - truth))),
            ("guided by solved maps", shown(guided)), (f"difference × {GAIN:g}", shown(GAIN * np.abs(guided - truth)))]
