"""Real captures relit from a part of their lights, against the images of the others: what lies between lights, and beyond them.

    python -m benchmarks.left_out OBJECT ... [--work DIR]

prints the errors of DiLiGenT objects, folders such as diligent_cat. With `--work`, captures and solved maps are kept there and used again,
and the predicted pictures lie beside them. docs/figures.md has the table of benchmarks.figures.
"""

import argparse
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.relighting import rgb
from benchmarks.rti_baselines import rti_fits
from service.relight.relight import relight
from service.requests.relight import LightWeights, RelightRequest
from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.capture.capture import Capture
from stage.importers import diligent
from stage.results.maps import MAPS_FILE
from stage.stack.correction import Correction
from tests.reference.colour import srgb

EVERY = 8
"""Every light with an index that this number divides is left out: 12 of 96."""
RIM_DEGREES = 30.0
"""Lights farther than this from the view axis are left out to test what lies beyond the others; the outermost are at 43 degrees."""
DISC_DEGREES = 0.5
WHITE_PERCENTILE = 99.9
"""The value of the captured images that is white on the display; brighter ones are clipped, as in a photograph."""
FIT_PIXELS = 4096
"""Most pixels on which the width of radial basis functions is chosen."""
RTI_BETWEEN = "between"


class LeftOut(NamedTuple):
    """A capture without some of its lights, and the images of these."""

    folder: Path
    """The capture; beside it the folders of results."""
    mask: np.ndarray  # [rows, cols] bool
    captured: np.ndarray  # [lights, 3] directions of the captured lights
    images: np.ndarray  # [lights, pixels, 3] float32, radiance under irradiance 1
    wanted: np.ndarray  # [n, 3] directions of the lights that were left out
    irradiance: np.ndarray  # [n, 3] of these
    truth: np.ndarray  # [n, pixels, 3] float64 radiance


class Scores(NamedTuple):
    """How well the images of lights that were left out are predicted."""

    rmse: float
    """Relative RMSE of radiance; NaN for fits of display values."""
    psnr: float
    """Decibels between 8-bit sRGB pictures, over all pixels of the object and all of these lights."""


def every_eighth(directions: np.ndarray) -> list[int]:
    """Return the lights that are left out between others."""
    return list(range(EVERY // 2, len(directions), EVERY))


def rim(directions: np.ndarray) -> list[int]:
    """Return the lights that are left out beyond others."""
    return np.flatnonzero(directions[:, 2] < np.cos(np.radians(RIM_DEGREES))).tolist()


def leave_out(source: Path, work: Path, choose: Callable[[np.ndarray], list[int]]) -> LeftOut:
    """Import a DiLiGenT object without some of its lights.

    Args:
        source: folder of the object.
        work: an empty folder, or that of an earlier call with the same arguments.
        choose: returns the lights that are left out, from directions [lights, 3].
    """
    whole, rest = work / "whole", work / "rest"
    if not whole.exists():
        diligent.import_folder(source, whole)
    manifest = json.loads((whole / "capture.json").read_text())
    frames = manifest["frames"]
    directions = np.array([frame["light"]["direction"] for frame in frames])
    irradiance = np.array([frame["light"]["irradiance"] for frame in frames])
    out = choose(directions)
    kept = [index for index in range(len(frames)) if index not in out]
    if not rest.exists():
        shutil.copytree(whole, rest)
        manifest["frames"] = [frames[index] for index in kept]
        (rest / "capture.json").write_text(json.dumps(manifest))
    keys = {"schema": "relit.keys/1", "lights": [{
        "name": frames[index]["image"],
        "keys": [{"frame": number + 1, "direction": frames[index]["light"]["direction"], "angle_degrees": DISC_DEGREES,
                  "irradiance": frames[index]["light"]["irradiance"] if number == place else [0, 0, 0], "interpolation": "step"}
                 for number in range(len(out))]} for place, index in enumerate(out)]}
    (work / "keys.json").write_text(json.dumps(keys))
    capture = Capture.open(whole)
    mask, correction = capture.mask(), Correction.of(capture)
    radiance = np.stack([correction.apply(each).pixels[mask] for each in capture.sources()])
    return LeftOut(rest, mask, directions[kept], (radiance[kept] / irradiance[kept][:, None]).astype(np.float32), directions[out],
                   irradiance[out], radiance[out].astype(np.float64))


def predict(left: LeftOut, weights: LightWeights | None, *, guided: bool) -> np.ndarray:
    """Return the images of the left-out lights as `relit relight` predicts them, [n, pixels, 3] float64 radiance."""
    work = left.folder.parent
    maps = work / "maps" if guided else None
    if maps is not None and not (maps / MAPS_FILE).exists():
        solve(SolveRequest(capture=left.folder, out=maps, method=Method.SVBRDF, cache=work, albedo_scale=1.0))  # in the unit of the images
    name = "guided" if guided else str(weights)
    result = relight(RelightRequest(capture=left.folder, keys=work / "keys.json", frames=f"1-{len(left.wanted)}", weights=weights,
                                    maps=maps, out=str(work / f"{name}.##.exr"), cache=work, overwrite=True))
    return np.stack([rgb(path)[left.mask] for path in result.frames])


def left_out_scores(left: LeftOut, *, rti: bool) -> dict[str, Scores]:
    """Return how well the left-out lights of one object are predicted, by name of the method.

    Args:
        left: the object.
        rti: whether fits of software for relightable images take part; they mean nothing beyond the captured lights.
    """
    exposure = 1 / np.percentile(left.images, WHITE_PERCENTILE)
    truth = np.round(255 * srgb(exposure * left.truth / left.irradiance[:, None]))
    scores = {}

    def psnr(display: np.ndarray) -> float:
        return float(10 * np.log10(255**2 / np.mean((np.round(255 * display) - truth) ** 2)))

    for name, guided in [*((str(weights), False) for weights in LightWeights), ("guided", True)]:
        ours = predict(left, None if guided else LightWeights(name), guided=guided)
        error = float(np.sqrt(((ours - left.truth) ** 2).mean() / (left.truth**2).mean()))
        scores[name] = Scores(error, psnr(srgb(exposure * ours / left.irradiance[:, None])))
    if rti:
        shown = np.round(255 * srgb(exposure * left.images)).reshape(len(left.images), -1) / 255
        some = shown[:, :: max(1, shown.shape[1] // FIT_PIXELS)]
        for name, matrix in rti_fits(left.captured, left.wanted, some).items():
            scores[name] = Scores(float("nan"), psnr(np.clip(matrix @ shown, 0, 1).reshape(left.truth.shape)))
    return scores


def left_out_table(data: Path) -> list[str]:
    """Return the table as lines of Markdown.

    Args:
        data: folder with diligent_ball and diligent_cat.
    """
    lines = ["DiLiGenT objects: maps are solved and images are summed without some lights, and compared with these lights' images. "
             f"Between: every eighth light. Beyond: all lights more than {RIM_DEGREES:g}° from the view axis, 6 to 16° beyond; in "
             "brackets their number. The first number is the relative RMSE of radiance. The second is the PSNR in dB of 8-bit sRGB over "
             f"the object; percentile {WHITE_PERCENTILE:g} of the captured images is white. PTM, HSH and RBF "
             "(`benchmarks/rti_baselines.py`) are fitted to such sRGB images, as software for RTI does.", ""]
    found: dict[str, dict[str, Scores]] = {}
    for where, choose in ((RTI_BETWEEN, every_eighth), ("beyond", rim)):
        for name in ("ball", "cat"):
            with tempfile.TemporaryDirectory() as folder:
                left = leave_out(data / f"diligent_{name}", Path(folder), choose)
                found[f"{name}, {where} ({len(left.wanted)})"] = left_out_scores(left, rti=where == RTI_BETWEEN)
    methods = list(max(found.values(), key=len))
    lines += ["| | " + " | ".join(found) + " |", "|---" * (len(found) + 1) + "|"]
    return lines + ["| " + " | ".join([_titled(method), *(_cell(scores.get(method)) for scores in found.values())]) + " |"
                    for method in methods]


def _titled(method: str) -> str:
    return {"guided": "`--maps`"}.get(method, f"`--weights {method}`" if method in set(LightWeights) else method)


def _cell(scores: Scores | None) -> str:
    if scores is None:
        return "–"
    return f"{scores.psnr:.1f} dB" if np.isnan(scores.rmse) else f"{scores.rmse:.3f}, {scores.psnr:.1f} dB"


def main() -> None:
    """Print the errors of some objects, every eighth light left out."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("object", type=Path, nargs="+", help="folder of a DiLiGenT object")
    parser.add_argument("--work", type=Path, help="folder where captures, maps and pictures are kept")
    given = parser.parse_args()
    for source in given.object:
        with tempfile.TemporaryDirectory() as folder:
            work = Path(folder) if given.work is None else given.work / source.name
            work.mkdir(parents=True, exist_ok=True)
            for name, scores in left_out_scores(leave_out(source, work, every_eighth), rti=True).items():
                print(f"{source.name}: {name}: {_cell(scores)}", flush=True)


if __name__ == "__main__":
    main()
