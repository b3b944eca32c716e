"""relit demo: solve, export and relight the shipped sample, and show the results in one image."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels import device as devices
from service.export.export import export
from service.relight.relight import relight
from service.relight.sheet import BACKGROUND, display, exposure_of, read_frame, write_sheet
from service.reporting.progress import Progress, Timings
from service.requests.demo import DemoRequest, sample_folder
from service.requests.export import ExportRequest
from service.requests.relight import RelightRequest
from service.requests.solve import SolveRequest
from service.solve.solve import SolveResult, solve
from stage.capture.capture import Capture
from stage.capture.lighting import distant_lights
from stage.colour.colour import convert
from stage.results.maps import SurfaceMaps
from stage.stack.correction import Correction
from stage.stack.ingest import CACHE_FOLDER

FRAMES = "1-24"
KEY_LIGHT = (0.45, 0.5, 0.74)
"""The preview shows the captured image whose light is nearest to this direction, above right of the camera."""


class DemoResult(NamedTuple):
    """The results of the demo."""

    solved: SolveResult
    asset: Path
    frames: tuple[Path, ...]
    preview: Path


def demo(request: DemoRequest, progress: Progress | None = None) -> DemoResult:
    """Solve, export and relight the sample, and write a preview; the cache lies with the results, so that the sample stays as it is."""
    sample, out, device = sample_folder(), request.out, devices.resolve(request.device)
    cache = out / CACHE_FOLDER
    solved = solve(SolveRequest(capture=sample, out=out, device=device, cache=cache), progress)
    asset = export(ExportRequest(maps=out, out=out / "asset.usdz"), progress).path
    relit = relight(RelightRequest(capture=sample, environment=sample / "environment.exr", out=str(out / "frame.####.exr"),
                                   frames=FRAMES, spin_degrees=360.0, device=device, cache=cache), progress)
    timings = Timings(progress)
    timings.stage("preview", 1)
    preview = out / "preview.png"
    capture = Capture.open(sample)
    nearest = int((distant_lights(capture).direction @ KEY_LIGHT).argmax())
    captured = Correction.of(capture).apply(capture.sources()[nearest]).pixels
    write_preview(preview, solved.maps, captured, relit.frames)
    timings.close()
    return DemoResult(solved, asset, relit.frames, preview)


def write_preview(path: Path, maps: SurfaceMaps, captured: np.ndarray, frames: Sequence[Path]) -> None:
    """Write the preview of a solve: its maps, a captured image [rows, cols, 3] scene-linear, and two rows of frames, evenly chosen."""
    mask = maps.mask
    top = [("captured, one light", display(captured * exposure_of(captured[None], mask), maps.color_space))]
    if maps.normal is not None:
        top.append(("normals", np.where(mask[..., None], 0.5 + 0.5 * maps.normal, BACKGROUND)))
    if maps.diffuse_albedo is not None:
        albedo = convert(np.clip(maps.diffuse_albedo, 0, 1).astype(np.float32), maps.color_space, "srgb_rec709_scene")
        top.append(("diffuse albedo", np.where(mask[..., None], albedo, BACKGROUND)))
    if maps.roughness is not None:
        grey = np.repeat(maps.roughness.astype(np.float32)[..., None], 3, axis=-1)
        top.append(("roughness", np.where(mask[..., None], grey, BACKGROUND)))
    if maps.height is not None:
        top.append(("height", _relief(maps.height, mask)))
    count = min(2 * len(top), len(frames))
    shown = [frames[i] for i in np.linspace(0, len(frames), count, endpoint=False).astype(int)]
    relit = np.stack([read_frame(frame)[0] for frame in shown])
    together = (relit * exposure_of(relit, mask)).reshape(-1, *relit.shape[2:])  # the transform is made once for all
    bottom = [(f"relit, {frame.stem}", pixels)
              for frame, pixels in zip(shown, display(together, maps.color_space).reshape(relit.shape), strict=True)]
    write_sheet(path, [row for row in (top, bottom[: len(top)], bottom[len(top) :]) if row])


def _relief(height: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the height as grey, bright where it is near the camera."""
    low, high = np.percentile(height[mask], [0.5, 99.5])
    grey = np.clip((height - low) / max(high - low, 1e-12), 0, 1)
    return np.where(mask[..., None], np.repeat((0.12 + 0.83 * grey)[..., None], 3, axis=-1), BACKGROUND)
