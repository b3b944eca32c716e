"""Depth from every projected code against the path-traced rig's ground truth, and a picture of some, docs/depth.png.

    python -m benchmarks.rig DIR      DIR holds the sets of samples/make_rig.py; prints the tables and writes the picture
"""

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_erosion

from benchmarks.pictures import FULL_SCALE_DEG, heat
from service.depth.depth import depth
from service.relight.sheet import write_sheet
from service.requests.depth import DepthRequest
from stage.capture.capture import Capture
from stage.capture.light import LaserPlane, LaserRay
from stage.formats import exr
from stage.formats.images import read_pixels
from stage.formats.ply import read_ply

TARGET = Path(__file__).parents[1] / "docs" / "depth.png"
WRONG_PX = 4.0
"""The error in columns above which a decoded column is wrong and not inaccurate: a quarter of the shortest period."""
FAR_M = 1.4
"""The least distance at which laser stripes are judged."""
BEAM_PX = 3
"""The radius of the laser beam in camera pixels: points at which an edge crosses the beam are not judged."""
ONE_COLUMN = 1 + 1e-4
"""One column, with a tolerance for the float32 result."""
NAMES = {
    "gray": "Gray, inverses",
    "gray_both": "Gray, inverses, columns and rows",
    "ternary": "reflected ternary",
    "ramp": "ramp pair",
    "phase": "phase 16/18/21, 4 steps",
    "gray_phase": "phase 16, 4 steps, Gray",
    "long_phase": "phase 256, 8 steps",
    "micro": "micro phase shifting",
    "modulated": "modulated phase 256",
    "xor": "XOR, stripes of 2",
    "xor_phase": "phase 16, 4 steps, XOR",
}
LASERS = {"spots": "spots", "planes": "stripes"}
ROBUST = ("phase", "gray_phase", "micro", "modulated", "xor", "xor_phase")
"""The codes whose precision does not depend on wide stripes or long waves."""
PICTURED = ("gray", "ramp", "long_phase", "gray_phase", "micro")
FULL_SCALE_M = 0.01


class Truth(NamedTuple):
    """The ground truth of the rig, [rows, cols] each."""

    depth: np.ndarray  # float32 metres
    u: np.ndarray  # float32 projector columns
    lit: np.ndarray  # bool
    shadow: np.ndarray  # bool
    clean: np.ndarray  # bool, lit and not mixed
    groove: np.ndarray  # bool, clean and on the groove's walls


class CodeError(NamedTuple):
    """The errors of one code over the lit pixels that no edge crosses."""

    frames: int
    coverage: float  # of all lit pixels
    let_through: float  # of the shadow pixels
    column: np.ndarray  # [n] absolute error of each solved clean pixel, projector columns
    depth_m: np.ndarray  # [n] absolute
    depth: np.ndarray  # [rows, cols] metres
    solved: np.ndarray  # [rows, cols] bool
    groove_column: np.ndarray  # [m] those of the groove
    groove_coverage: float


def read_truth(path: Path) -> Truth:
    """Read the truth.exr of the rig."""
    channels, _ = exr.read(path)
    lit, shadow, mixed, groove = (channels[f"{name}.Y"] > 0.5 for name in ("mask", "shadow", "mixed", "groove"))
    clean = lit & ~mixed
    return Truth(channels["depth.Z"], channels["projector.U"], lit, shadow, clean, clean & groove)


def measure(folder: Path, device: str | None = None) -> CodeError:
    """Run `relit depth` on one set and return its errors."""
    truth = read_truth(folder / "truth.exr")
    with tempfile.TemporaryDirectory() as out:
        maps = depth(DepthRequest(capture=folder, out=Path(out), cache=Path(out), device=device)).maps
    assert maps.projector_u is not None
    found = truth.clean & maps.mask
    error = np.abs(maps.projector_u - truth.u)
    return CodeError(
        frames=len(Capture.open(folder).manifest.frames),
        coverage=float(maps.mask[truth.lit].mean()),
        let_through=float(maps.mask[truth.shadow].mean()),
        column=error[found],
        depth_m=np.abs(maps.depth - truth.depth)[found],
        depth=maps.depth,
        solved=maps.mask,
        groove_column=error[truth.groove & maps.mask],
        groove_coverage=float(maps.mask[truth.groove].mean()),
    )


class LaserError(NamedTuple):
    """The errors of laser spots or stripes."""

    frames: int
    depth_m: np.ndarray  # [points] absolute error at clean places
    truth_m: np.ndarray  # [points] true depth
    groove: np.ndarray  # [points] bool


def measure_laser(folder: Path, device: str | None = None) -> LaserError:
    """Run `relit depth` on laser frames, and return the distances of the measured points from the true surface."""
    truth, capture = read_truth(folder / "truth.exr"), Capture.open(folder)
    camera = capture.camera
    with tempfile.TemporaryDirectory() as out:
        result = depth(DepthRequest(capture=folder, out=Path(out), cache=Path(out), device=device))
        points = read_ply(result.points_path).points.astype(np.float64)
    assert camera.focal_px is not None and camera.principal_px is not None
    z = -points[:, 2]
    x, down = points[:, 0] / z, -points[:, 1] / z
    if camera.distortion is not None:
        x, down = camera.distortion.apply(x, down)
    u = camera.focal_px[0] * x + camera.principal_px[0] - 0.5  # as an index: pixel centres at whole numbers
    v = camera.focal_px[1] * down + camera.principal_px[1] - 0.5
    col, row = (np.clip(np.floor(x).astype(int), 0, limit - 2) for x, limit in ((u, camera.width), (v, camera.height)))
    whole = binary_erosion(truth.clean, np.ones((3, 3)), iterations=BEAM_PX)  # not beyond the image's border either
    true, clean = np.zeros(len(points)), np.ones(len(points), bool)
    du, dv = np.clip(u - col, 0, 1), np.clip(v - row, 0, 1)
    for down, across in ((0, 0), (0, 1), (1, 0), (1, 1)):  # 1/depth of a plane is linear in the image
        weight = (dv if down else 1 - dv) * (du if across else 1 - du)
        true += weight / truth.depth[row + down, col + across]
        clean &= whole[row + down, col + across]
    lasers = sum(isinstance(frame.laser, LaserRay | LaserPlane) for frame in capture.manifest.frames)
    inside = truth.groove[np.clip(np.rint(v).astype(int), 0, camera.height - 1), np.clip(np.rint(u).astype(int), 0, camera.width - 1)]
    return LaserError(lasers, np.abs(z - 1 / true)[clean], 1 / true[clean], inside[clean])


Measured = dict[str, CodeError | LaserError]


def measure_all(folder: Path) -> Measured:
    """Measure every set in a folder."""
    found: Measured = {name: measure(folder / name) for name in NAMES if (folder / name / "capture.json").exists()}
    found |= {name: measure_laser(folder / name) for name in LASERS if (folder / name / "capture.json").exists()}
    return found


def _percentile(values: np.ndarray, percent: float) -> float:
    return float(np.percentile(values, percent)) if values.size else float("nan")


def code_lines(found: Measured) -> list[str]:
    """Return the table of the codes."""
    lines = ["| code | images | lit pixels decoded | shadow let through | column, median | 99 % | over one column | another place "
             "| depth, median mm | groove: column, median | 95 % | decoded |", "|---|" + "---|" * 11]
    for name, error in found.items():
        if not isinstance(error, CodeError):
            continue
        over, wrong = (float((error.column > limit).mean()) for limit in (ONE_COLUMN, WRONG_PX))
        lines.append(f"| {NAMES[name]} | {error.frames} | {100 * error.coverage:.1f} % | {100 * error.let_through:.1f} % | "
                     f"{_percentile(error.column, 50):.3g} | {_percentile(error.column, 99):.3g} | {100 * over:.3g} % | "
                     f"{100 * wrong:.3g} % | {1000 * _percentile(error.depth_m, 50):.3g} | {_percentile(error.groove_column, 50):.3g} | "
                     f"{_percentile(error.groove_column, 95):.3g} | {100 * error.groove_coverage:.1f} % |")
    return lines


def laser_lines(found: Measured) -> list[str]:
    """Return the table of the lasers."""
    lines = ["| laser | frames | points | depth, median mm | 90 % | 99 % | largest "
             "| median at 1.4 m and beyond | points in the groove | median |",
             "|---|" + "---|" * 9]
    for name, title in LASERS.items():
        error = found.get(name)
        if isinstance(error, LaserError):
            open_m, groove_m = error.depth_m[~error.groove], error.depth_m[error.groove]
            far = error.depth_m[~error.groove & (error.truth_m >= FAR_M)]
            figures = [*(_percentile(open_m, percent) for percent in (50, 90, 99, 100)), _percentile(far, 50)]
            lines.append(f"| {title} | {error.frames} | {open_m.size} | {' | '.join(f'{1000 * x:.3g}' for x in figures)} | "
                         f"{groove_m.size} | {1000 * _percentile(groove_m, 50):.3g} |")
    return lines


class Limit(NamedTuple):
    """The limit that the errors of a set must not exceed."""

    name: str
    what: str
    value: Callable[[CodeError], float]
    most: float


STRIPE_MEDIAN_PX = 0.27
"""The limit of a median error: 0.25 columns for errors that are uniform over half a column, and what edges add."""


def _over_one(error: CodeError) -> float:
    return float((error.column > ONE_COLUMN).mean())


LIMITS = (
    Limit("gray", "pixels over one column", _over_one, 0.0),
    Limit("gray", "column, median", lambda e: _percentile(e.column, 50), STRIPE_MEDIAN_PX),
    Limit("ternary", "pixels over one column", _over_one, 0.003),
    Limit("ramp", "column, median", lambda e: _percentile(e.column, 50), 0.7),
    *(Limit(name, what, value, most) for name in ("phase", "gray_phase") for what, value, most in (
        ("pixels at another place", lambda e: float((e.column > WRONG_PX).mean()), 0.0),
        ("column, median", lambda e: _percentile(e.column, 50), 0.014),
        ("depth, median mm", lambda e: 1000 * _percentile(e.depth_m, 50), 0.30))),
    *(Limit(name, what, value, most) for name in ("gray", "phase", "gray_phase") for what, value, most in (
        ("lit pixels not decoded", lambda e: 1 - e.coverage, 0.03),
        ("shadow pixels let through", lambda e: e.let_through, 0.10))),
)


def limit_lines(found: Measured) -> list[str]:
    """Return the table of limits and measured errors."""
    rows = [(NAMES[limit.name], limit.what, limit.value(error), limit.most)
            for limit in LIMITS if isinstance(error := found.get(limit.name), CodeError)]
    spots, planes, plain = found.get("spots"), found.get("planes"), found.get("long_phase")
    if isinstance(spots, LaserError):
        rows.append(("laser spots", "depth, largest mm", 1000 * _percentile(spots.depth_m[~spots.groove], 100), 1.2))
    if isinstance(planes, LaserError):
        far = planes.depth_m[~planes.groove & (planes.truth_m >= FAR_M)]
        rows.append(("laser stripes", "depth, median mm at 1.4 m and beyond", 1000 * _percentile(far, 50), 0.15))
    if isinstance(plain, CodeError):
        for name in ROBUST:
            if isinstance(error := found.get(name), CodeError):
                ratio = _percentile(error.groove_column, 50) / _percentile(plain.groove_column, 50)
                rows.append((NAMES[name], "groove: column, median, divided by that of phase 256", ratio, 0.5))
    return ["| | quantity | limit | measured | |", "|---|---|---|---|---|",
            *(f"| {name} | {what} | {most:g} | {value:.3g} | {'' if value <= most else 'missed'} |" for name, what, value, most in rows)]


def rig_table(folder: Path) -> list[str]:
    """Return the tables of every set in a folder as lines of Markdown."""
    found = measure_all(folder)
    return ["`samples/make_rig.py`: a projector and a camera of 256 × 192 pixels 0.3 m apart, path traced with interreflection (a quarter "
            "of the light in the groove), ambient light, no camera noise, images in half precision; one column is about 21 mm of depth at "
            "1.4 m. Errors are those of lit pixels that no edge of depth or shadow crosses.", "",
            *code_lines(found), "", *laser_lines(found), "", *limit_lines(found)]


def picture(folder: Path, target: Path = TARGET) -> None:
    """Draw depth and its error under some codes side by side."""
    names = [name for name in PICTURED if (folder / name / "capture.json").exists()]
    truth = read_truth(folder / names[0] / "truth.exr")
    low, high = np.percentile(truth.depth, [0, 100])

    def relief(depth_m: np.ndarray, solved: np.ndarray) -> np.ndarray:
        grey = 0.12 + 0.83 * np.clip((high - depth_m) / (high - low), 0, 1)
        return np.where(solved[..., None], np.repeat(grey[..., None], 3, axis=-1), 0)

    capture = Capture.open(folder / "gray_phase")
    white = next(frame.image for frame in capture.manifest.frames if frame.pattern is not None and frame.pattern.code == "white")
    lit = np.clip(read_pixels(capture.folder / white).astype(np.float64), 0, 1) ** (1 / 2.2)
    upper, lower = [("projector white", lit)], [("true depth", relief(truth.depth, np.ones_like(truth.lit)))]
    for name in names:
        error = measure(folder / name)
        upper.append((NAMES[name], relief(error.depth, error.solved)))
        lower.append((f"error, 0 to {1000 * FULL_SCALE_M:g} mm: median {1000 * np.median(error.depth_m):.2g}",
                      heat(np.abs(error.depth - truth.depth) * (FULL_SCALE_DEG / FULL_SCALE_M), error.solved)))
    write_sheet(target, [upper, lower], height=192)


def main() -> None:
    """Print the tables and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    print("\n".join(rig_table(folder)))
    picture(folder)


if __name__ == "__main__":
    main()
