"""Time of flight through `relit depth`, on raw frames of the tests' independent simulator: error, wrong wraps and how true sigma is."""

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from service.depth.depth import depth
from service.requests.depth import DepthRequest, TofOptions
from stage.results.depth_maps import DepthMaps
from tests.reference import tof as scenes

ROWS, COLS = 96, 128
FOCAL_PX = 110.0
WRONG_M = 0.9
"""The error in metres above which a range is wrong: half the range of one period at 80 MHz."""
SEED = 11


def solved_maps(frames: list[tuple[np.ndarray, dict[str, Any]]], vote: bool = True) -> DepthMaps:
    """Run `relit depth` on raw frames and return its maps."""
    with tempfile.TemporaryDirectory() as name:
        folder, entries = Path(name), []
        for index, (values, light) in enumerate(frames):
            np.save(folder / f"{index:02d}.npy", values)
            entries.append({"image": f"{index:02d}.npy", "tof": light})
        (folder / "capture.json").write_text(json.dumps({
            "schema": "relit.capture/1", "name": "room", "frames": entries,
            "camera": {"projection": "perspective", "resolution": [COLS, ROWS], "focal_px": [FOCAL_PX, FOCAL_PX]}}))
        options = TofOptions.model_validate({"vote": vote})
        return depth(DepthRequest(capture=folder, out=folder / "out", tof=options, device="cpu")).maps


def measured(frames: list[tuple[np.ndarray, dict[str, Any]]], view: scenes.View, vote: bool = True) -> tuple[float, float, float, float]:
    """Return the median error in mm, the parts of the pixels that are wrong and unsolved, and the RMS of error over sigma."""
    maps = solved_maps(frames, vote)
    assert maps.range is not None and maps.sigma is not None
    error = (maps.range - view.distance)[maps.mask]
    right = np.abs(error) < WRONG_M
    along = (maps.depth / np.maximum(maps.range, 1e-9))[maps.mask]
    share = float(np.sqrt(np.mean((error * along / maps.sigma[maps.mask])[right] ** 2)))
    return 1000 * float(np.median(np.abs(error))), float(np.mean(~right)), float(1 - maps.mask.mean()), share


def accuracy_rows() -> list[str]:
    """Return the table as lines of Markdown."""
    view = scenes.room(ROWS, COLS)
    settings = scenes.even(scenes.HZ, 4)
    megahertz = "/".join(f"{hz / 1e6:g}" for hz in scenes.HZ)
    span = f"{view.distance.min():.2g} to {view.distance.max():.3g} m"
    lines = [f"A room of {COLS} × {ROWS} pixels, {span}, raw frames by the simulator of the tests: four phases at {megahertz} MHz, A = 10⁵ "
             "· albedo · cos θ / d² electrons, read noise 5; histograms of 64 bins of 1.5 ns, 4000 · albedo · cos θ / d² counts.", "",
             "| | light | median error, mm | wrong wraps | no depth | error over sigma, RMS |", "|---|---|---|---|---|---|"]

    def row(what: str, light: str, found: tuple[float, float, float, float]) -> None:
        lines.append(f"| {what} | {light} | {found[0]:.3g} | {100 * found[1]:.2g} % | {100 * found[2]:.2g} % | {found[3]:.3g} |")

    for title, part in (("whole", 1.0), ("a fifth", 0.2)):
        images = scenes.correlations(view, 1e5 * part, settings, seed=SEED)
        frames = [(image, {"type": "cw", "modulation_hz": hz, "reference_phase_rad": delta})
                  for image, (hz, delta) in zip(images, settings, strict=True)]
        row("continuous wave, each pixel alone", title, measured(frames, view, vote=False))
        row("continuous wave, with the vote", title, measured(frames, view))
        counts = scenes.histogram(view, 4000 * part, background=0.02, seed=SEED)
        row("histograms", title, measured([(counts, {"type": "pulsed", "bin_s": 1.5e-9, "start_s": 0.0})], view))
    return lines
