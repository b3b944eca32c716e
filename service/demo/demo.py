"""relit demo: solve, export and relight the shipped sample, and show the results in one image."""

from pathlib import Path
from typing import NamedTuple

import service
from kernels import device as devices
from service.demo.preview import write_preview
from service.errors import RequestError
from service.export.export import export
from service.light.relight import relight
from service.reporting.progress import Progress, Timings
from service.requests.demo import DemoRequest
from service.requests.export import ExportRequest
from service.requests.relight import RelightRequest
from service.requests.solve import SolveRequest
from service.solve.solve import SolveResult, solve
from stage.capture import Capture
from stage.correction import Correction
from stage.ingest import CACHE_FOLDER
from stage.lighting import distant_lights

SAMPLE = "owl"
FRAMES = "1-24"
KEY_LIGHT = (0.45, 0.5, 0.74)
"""The preview shows the captured image whose light is nearest to this direction, above right of the camera."""


class DemoResult(NamedTuple):
    """The results of the demo."""

    solved: SolveResult
    asset: Path
    frames: tuple[Path, ...]
    preview: Path


def sample_folder() -> Path:
    """Return the folder of the shipped sample, inside the installed package or in the checkout.

    Raises:
        RequestError: the sample is in neither.
    """
    package = Path(service.__file__).parent
    for folder in (package / "samples" / SAMPLE, package.parent / "samples" / SAMPLE):
        if (folder / "capture.json").exists():
            return folder
    raise RequestError(f"the sample capture {SAMPLE} is not installed: run the demo from a checkout of relit")


def demo(request: DemoRequest, progress: Progress | None = None) -> DemoResult:
    """Solve, export and relight the sample, and write a preview.

    Args:
        request: the device, and the folder for the results; its `.relit` holds the stack cache, so that nothing is written into the sample.
        progress: told how far the work is.
    """
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
