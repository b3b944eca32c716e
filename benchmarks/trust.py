"""Judge σ and confidence of every method on scenes in and out of its model, and write docs/trust.md and docs/trust.png.

    python -m benchmarks.trust [--data DIR] [--only MODULE ...]

`--data` is a folder with the real captures of docs/figures.md; what needs them, or Mitsuba, is left out where it is missing. With `--only`
the rows of these modules are written anew, and the picture stays.
"""

import argparse
import importlib
import pkgutil
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

import benchmarks.trials
from benchmarks.trials.trial import Trial
from stage.files import write_text

DOCS = Path(__file__).parents[1] / "docs"
TABLE, PICTURE = DOCS / "trust.md", DOCS / "trust.png"
FAR_SIGMAS = 5.0
"""An error is far out if it is more than this many σ."""
FAR_DEGREES = 5.0
"""A normal is far out if it is also more than this many degrees off."""
PANEL, PANEL_COLUMNS, MARGIN = (260, 170), 5, 24
"""Width and height of one curve in pixels, curves in a row, and the room around each for its words."""
HEAD = """# How far confidence can be trusted

*After reading this page you can tell by how much the results of each method may be wrong where they say that they are sure.*

`python -m benchmarks.trust --data DIR` measures this table and the picture below. Errors count every pixel whose truth is known.

- *Solved*: part of these pixels that counts as solved with the defaults.
- *|e| / σ*: median of the error over the predicted standard deviation of solved pixels. It is 0.67 where a depth's errors are normal and
  σ is right, and 0.83 for the angle of a normal; above 1.4 the result claims more than it knows.
- *Far out*: part of solved pixels that are off by more than five σ (normals: and by more than five degrees).
- *Error, all and best half*: mean error of the solved pixels, and of the half of them with the highest confidence.
- *Model*: whether the scene is one that the method's model describes.
- No sentence and no σ tells of a light source of a time-of-flight camera that stands aside and is not declared: it makes all frequencies
  wrong by the same length, so that nothing in the frames contradicts it.
- A camera that shakes, or drifts while the lamps burn row by row, is told by the texture of the object: not where there is none or little.
  A slow slide from the first image to the last is told by outlines and shading, in 67 of 91 captures under 12 to 40 lights that
  slide by 3.3 px.
  2 px over 48 images turn normals of *figure* by 5° in the median.
- Of a translucent body normals are told to be blurred by the edges of its shadows in red and in blue: not where few shadows fall on it,
  in JPEG files, where it scatters all colours alike, or where light runs much farther in it than its shadows are wide.

"""
COLUMNS = ("| scene | model | pixels | solved | \\|e\\| / σ | far out | error, all | best half | confidence, median |\n"
           "|---|---|---|---|---|---|---|---|---|")

CAPTION = """![error of the pixels kept against the fraction kept](trust.png)

*Error of the pixels kept, from 0 to the number shown, against the fraction kept, surest first; grey: if those with the least error were
kept. Blue: in the model; red: out of it.*
"""


class Judgement(NamedTuple):
    """One line of the table."""

    solved: float
    ratio: float
    """Median of error over σ of solved pixels; NaN without any."""
    far_out: float
    mean: float
    best_half: float
    confidence: float


def judge(trial: Trial) -> Judgement:
    """Return what σ and confidence of a trial are worth."""
    kept = trial.solved
    if not kept.any():
        return Judgement(0.0, np.nan, np.nan, np.nan, np.nan, np.nan)
    error, sigma = trial.error[kept].astype(np.float64), np.maximum(trial.sigma[kept].astype(np.float64), 1e-9)
    far = error > FAR_SIGMAS * sigma
    if trial.unit == "°":
        far &= error > FAR_DEGREES
    kept_error = risk(trial)
    return Judgement(float(kept.mean()), float(np.median(error / sigma)), float(far.mean()), float(error.mean()),
                     float(kept_error[(len(kept_error) - 1) // 2]), float(np.median(trial.confidence[kept])))


def risk(trial: Trial, *, by_error: bool = False) -> np.ndarray:
    """Return the mean error of the surest 1, 2, 3 … solved pixels, [solved]; by_error: of those with the least error instead."""
    error = trial.error[trial.solved].astype(np.float64)
    ties = np.random.default_rng(0).random(len(error))
    order = np.argsort(error) if by_error else np.lexsort((ties, -trial.confidence[trial.solved]))
    return np.cumsum(error[order]) / np.arange(1, len(error) + 1)


def row(trial: Trial) -> str:
    """Return one line of the table, and under it the sentence that the result carries."""
    found = judge(trial)
    lead = f"| {trial.name} | {'in' if trial.in_model else 'out'} | {len(trial.error)} | {100 * found.solved:.1f} % |"
    if not trial.solved.any():
        line = f"{lead} – | – | – | – | – |"
    else:
        line = (f"{lead} {found.ratio:.2f} | {100 * found.far_out:.2f} % | {found.mean:.3g} {trial.unit} | "
                f"{found.best_half:.3g} {trial.unit} | {found.confidence:.2f} |")
    note = re.sub(rf"{re.escape(tempfile.gettempdir())}/[^/\s]+/", "", trial.note)  # where the scene lay for a moment
    return f"{line}\n| *{note}* | | | | | | | | |" if note else line


def renewed(before: str, rows: list[str]) -> str:
    """Return the page with the rows of some trials replaced, each with the sentence under it; new ones follow the last of them."""
    found = {row.split("|")[1]: row for row in rows}
    lines: list[str] = []
    ends = [number for number, line in enumerate(before.split("\n"), start=1) if line.startswith("|")]
    inside, last = False, ends[-1] if ends else len(before.split("\n"))  # whether a trial's old sentence goes; the line behind the last row
    for line in before.split("\n"):
        name = line.split("|")[1] if line.startswith("| ") else ""
        if inside and name.startswith(" *"):
            continue
        inside = name in found
        lines.append(found.pop(name) if inside else line)
        last = len(lines) if inside else last
    return "\n".join([*lines[:last], *found.values(), *lines[last:]])


def picture(trials: list[Trial]) -> np.ndarray:
    """Return the risk–coverage curves, [rows, cols, 3] uint8: error of the pixels kept against the fraction kept, surest first.

    The dark line keeps the most confident pixels; the light one those with the least error, which no confidence can beat.
    """
    width, height = PANEL[0] + MARGIN, PANEL[1] + 2 * MARGIN
    shown = [trial for trial in trials if trial.solved.sum() > 1]
    canvas = np.full((height * -(-len(shown) // PANEL_COLUMNS), width * PANEL_COLUMNS, 3), 255, np.uint8)
    for index, trial in enumerate(shown):
        top, left = height * (index // PANEL_COLUMNS) + MARGIN, width * (index % PANEL_COLUMNS) + MARGIN // 2
        best, found = risk(trial, by_error=True), risk(trial)
        full = max(float(found[len(found) // 50 :].max()), 1e-9)
        cv2.rectangle(canvas, (left, top), (left + PANEL[0], top + PANEL[1]), (200, 200, 200), 1)
        for curve, colour in ((best, (190, 190, 190)), (found, (150, 70, 20) if trial.in_model else (30, 60, 200))):
            at = np.linspace(len(curve) // 50, len(curve) - 1, PANEL[0]).astype(int)
            height_px = np.clip(curve[at] / full, 0, 1) * (PANEL[1] - 6)
            line = np.stack([left + np.arange(PANEL[0]), top + PANEL[1] - 2 - height_px], axis=-1)
            cv2.polylines(canvas, [np.rint(line).astype(np.int32)], False, colour, 1, cv2.LINE_AA)
        plain = trial.name.encode("ascii", "replace").decode()
        cv2.putText(canvas, plain[:44], (left, top - 7), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (0, 0, 0), 1, cv2.LINE_AA)
        unit = "deg" if trial.unit == "°" else trial.unit
        cv2.putText(canvas, f"{full:.3g} {unit}", (left + 4, top + 13), cv2.FONT_HERSHEY_SIMPLEX, 0.34, (90, 90, 90), 1, cv2.LINE_AA)
    return canvas


def every_trial(data: Path | None, only: list[str]) -> Iterator[Trial]:
    """Yield the trials of every module of benchmarks.trials, or of those that are named."""
    for found in pkgutil.iter_modules(benchmarks.trials.__path__):
        module = importlib.import_module(f"benchmarks.trials.{found.name}")
        if hasattr(module, "trials") and (not only or found.name in only):
            yield from module.trials(data)


def main() -> None:
    """Run the trials, print the table, and write it with its picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--only", nargs="*", default=[])
    options = parser.parse_args()
    rows, trials = [COLUMNS], []
    print(COLUMNS)
    for trial in every_trial(options.data, options.only):
        trials.append(trial)
        rows.append(row(trial))
        print(rows[-1], flush=True)
    if options.only:
        write_text(TABLE, renewed(TABLE.read_text(encoding="utf-8"), rows[1:]))
    else:
        write_text(TABLE, HEAD + "\n".join(rows) + "\n\n" + CAPTION)
        cv2.imwrite(str(PICTURE), picture(trials), [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
