"""Real captures relit from a part of their lights, against the images of the others: what lies between lights, and beyond them."""

import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks.relighting import rgb
from service.light.relight import relight
from service.requests.relight import LightWeights, RelightRequest
from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.capture import Capture
from stage.correction import Correction
from stage.importers import diligent

EVERY = 8
"""Every light with an index that this number divides is left out."""
RIM_DEGREES = 30.0
"""Lights farther than this from the view axis are left out to test what lies beyond the others; the outermost are at 43 degrees."""
DISC_DEGREES = 0.5


def every_eighth(directions: np.ndarray) -> list[int]:
    """Return the lights that are left out between others."""
    return list(range(EVERY // 2, len(directions), EVERY))


def rim(directions: np.ndarray) -> list[int]:
    """Return the lights that are left out beyond others."""
    return np.flatnonzero(directions[:, 2] < np.cos(np.radians(RIM_DEGREES))).tolist()


def left_out_errors(source: Path, choose: Callable[[np.ndarray], list[int]]) -> tuple[int, dict[str, float]]:
    """Predict the images of some lights of a DiLiGenT object from the others, and return their relative RMSE.

    Args:
        source: folder of the object.
        choose: returns the lights that are left out, from directions [lights, 3].
    """
    with tempfile.TemporaryDirectory() as folder:
        work, whole = Path(folder), Path(folder) / "whole"
        diligent.import_folder(source, whole)
        manifest = json.loads((whole / "capture.json").read_text())
        frames = manifest["frames"]
        out = choose(np.array([frame["light"]["direction"] for frame in frames]))
        capture = Capture.open(whole)
        mask, correction = capture.mask(), Correction.of(capture)
        truth = np.stack([correction.apply(capture.sources()[index]).pixels[mask] for index in out]).astype(np.float64)
        rest = work / "rest"
        shutil.copytree(whole, rest)
        manifest["frames"] = [frame for index, frame in enumerate(frames) if index not in out]
        (rest / "capture.json").write_text(json.dumps(manifest))
        keys = {"schema": "relit.keys/1", "lights": [{
            "name": frames[index]["image"],
            "keys": [{"frame": number + 1, "direction": frames[index]["light"]["direction"], "angle_degrees": DISC_DEGREES,
                      "irradiance": frames[index]["light"]["irradiance"] if number == place else [0, 0, 0], "interpolation": "step"}
                     for number in range(len(out))]} for place, index in enumerate(out)]}
        (work / "keys.json").write_text(json.dumps(keys))
        solve(SolveRequest(capture=rest, out=work / "maps", method=Method.SVBRDF, cache=work))
        errors = {}
        for name, weights, maps in (("cells", LightWeights.CELLS, None), ("smooth", LightWeights.SMOOTH, None),
                                    ("guided", None, work / "maps")):
            result = relight(RelightRequest(capture=rest, keys=work / "keys.json", frames=f"1-{len(out)}", weights=weights, maps=maps,
                                            out=str(work / f"{name}.##.exr"), cache=work))
            ours = np.stack([rgb(path)[mask] for path in result.frames])
            errors[name] = float(np.sqrt(((ours - truth) ** 2).mean() / (truth**2).mean()))
        return len(out), errors


def left_out_table(data: Path) -> list[str]:
    """Return the table as lines of Markdown.

    Args:
        data: folder with diligent_ball and diligent_cat.
    """
    lines = ["DiLiGenT objects: maps are solved and images are summed without some lights; relative RMSE of these lights' images. "
             f"Between: every eighth light. Beyond: all lights more than {RIM_DEGREES:g}° from the view axis, 6 to 16° beyond.", "",
             "| | left out | `--weights cells` | `--weights smooth` | `--maps` |", "|---|---|---|---|---|"]
    for where, choose in (("between", every_eighth), ("beyond", rim)):
        for name in ("ball", "cat"):
            count, errors = left_out_errors(data / f"diligent_{name}", choose)
            cells = " | ".join(f"{errors[key]:.3f}" for key in ("cells", "smooth", "guided"))
            lines.append(f"| {name}, {where} | {count} | {cells} |")
    return lines
