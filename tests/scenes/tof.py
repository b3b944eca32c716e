"""Captures of time of flight, written with NumPy and json alone: frames as the simulator of tests/reference/tof.py makes them."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

Frame = tuple[np.ndarray, dict[str, Any]]
"""Values, and what `tof` of the frame says."""
CAMERA = {"projection": "perspective", "resolution": [128, 96], "focal_px": [110.0, 110.0]}


def far_camera(rows: int, cols: int) -> dict[str, Any]:
    """A camera of so long a lens that depth is range."""
    return {"projection": "perspective", "resolution": [cols, rows], "focal_px": [1e4, 1e4]}


def cw_frames(images: Iterable[np.ndarray], settings: Iterable[tuple[float, float]], **more: Any) -> list[Frame]:
    """Images and their entries, of settings (modulation in Hz, reference phase)."""
    return [(image, {"type": "cw", "modulation_hz": hz, "reference_phase_rad": delta, **more})
            for image, (hz, delta) in zip(images, settings, strict=True)]


def pulsed_frames(counts: np.ndarray, **more: Any) -> list[Frame]:
    """Histograms [rows, cols, bins] and their entry."""
    return [(counts, {"type": "pulsed", "bin_s": 1.5e-9, "start_s": 0.0, **more})]


def write(folder: Path, frames: Iterable[Frame], *, camera: dict[str, Any] = CAMERA, **more: Any) -> Path:
    """A capture of these frames."""
    folder.mkdir(parents=True, exist_ok=True)
    entries = []
    for index, (values, light) in enumerate(frames):
        np.save(folder / f"{index:02d}.npy", values)
        entries.append({"image": f"{index:02d}.npy", "tof": light})
    manifest = {"schema": "relit.capture/1", "name": "room", "camera": camera, "frames": entries, **more}
    (folder / "capture.json").write_text(json.dumps(manifest))
    return folder
