"""Write docs/figures.md: every figure in it is measured here. A section whose data is not at hand keeps what it said before.

    python -m benchmarks.figures [--data DIR] [--glossy DIR] [--relighting DIR] [--rig DIR] [--large DIR] [--before DIR]
                                 [--megapixels N] [--only NAME ...]
"""

import argparse
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import date
from pathlib import Path

import numpy as np

from benchmarks.ablation import ablation_table
from benchmarks.accuracy import SolveError, compare, diligent_errors, read_truth, sample_errors
from benchmarks.device_asked import asked_rows
from benchmarks.device_estimate import estimate_rows
from benchmarks.device_registers import register_rows
from benchmarks.fresnel import fresnel_table
from benchmarks.large import FRAMES, LIGHTS, MEGAPIXELS, large_table
from benchmarks.left_out import left_out_table
from benchmarks.materials import material_table
from benchmarks.on_set import fault_table, time_table
from benchmarks.paired import paired_rows
from benchmarks.relighting import relighting_table
from benchmarks.rig import rig_table
from benchmarks.search_speed import search_rows
from benchmarks.spin import spin_table
from benchmarks.structured import structured_rows
from benchmarks.studio import studio_rows
from benchmarks.tof import rows as tof_rows
from benchmarks.tof_accuracy import accuracy_rows
from benchmarks.tof_bound import bound_rows
from service.demo.bench import bench
from service.requests.demo import BenchRequest
from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.capture.capture import Capture
from stage.files import write_text
from stage.formats import exr

TARGET = Path(__file__).parents[1] / "docs" / "figures.md"
DISTANT = (Method.LAMBERT, Method.ROBUST, Method.SVBRDF)
HEAD = "| method | solved | mean ° | median ° | albedo, median | height, RMS of relief |\n|---|---|---|---|---|---|"

Section = Callable[[argparse.Namespace], list[str] | None]


def row(name: str, error: SolveError) -> str:
    """Return one line of an accuracy table."""
    def percent(value: float) -> str:
        return "–" if np.isnan(value) else f"{100 * value:.3g} %"

    return (f"| {name} | {100 * error.coverage:.1f} % | {error.mean_deg:.4g} | {error.median_deg:.3g} | "
            f"{percent(error.albedo_median)} | {percent(error.height_rms)} |")


def lambert(_: argparse.Namespace) -> list[str]:
    """Measure the path-traced Lambertian sample."""
    return ["`samples/lambert`: a bumpy ball, 32 distant lights of unequal colour and strength, direct light with cast shadows, "
            "path traced.", "", HEAD, *(row(f"`{method}`", sample_errors("lambert", method)) for method in DISTANT)]


def real(given: argparse.Namespace) -> list[str] | None:
    """Measure the DiLiGenT objects."""
    if given.data is None:
        return None
    lines = ["DiLiGenT objects, 96 real lights; the cat at every second pixel. `lambert` leaves out readings of zero and of full scale; "
             "with them NumPy's `lstsq` has mean errors of 4.17° and 8.46°. Errors count every normal, solved or unsure.", "", HEAD]
    for name in ("ball", "cat"):
        lines += [row(f"{name}, `{method}`", diligent_errors(given.data / f"diligent_{name}", method)) for method in DISTANT]
    return lines


def glossy(given: argparse.Namespace) -> list[str] | None:
    """Measure the path-traced dielectric and metal."""
    if given.glossy is None:
        return None
    lines = ["`samples/make_glossy.py`: Mitsuba's `principled`, roughness 0.3 to 0.75, 64 lights, full interreflection. For "
             "the metal, F0 is compared in place of albedo; the error of roughness is absolute.", "",
             "| object | mean ° | median ° | albedo or F0, median | roughness, median |", "|---|---|---|---|---|"]
    for name in ("glossy", "glossy_metal"):
        folder = given.glossy / name
        truth, mask = read_truth(folder / "truth.exr"), Capture.open(folder).mask()
        with tempfile.TemporaryDirectory() as out:
            maps = solve(SolveRequest(capture=folder, out=Path(out), method=Method.SVBRDF, cache=Path(out))).maps
        error = compare(maps, truth, mask)
        channels, _ = exr.read(folder / "truth.exr")
        assert maps.roughness is not None and maps.specular is not None
        rough = np.median(np.abs(maps.roughness - channels["roughness.Y"])[mask & maps.mask])
        colour = error.albedo_median
        if name == "glossy_metal":
            true = truth["diffuse_albedo"][mask & maps.mask]
            colour = float(np.median(np.abs(maps.specular[mask & maps.mask] - true) / true))
        lines.append(f"| {name} | {error.mean_deg:.3g} | {error.median_deg:.3g} | {100 * colour:.2g} % | {rough:.2g} |")
    return lines


def speed(_: argparse.Namespace) -> list[str]:
    """Measure the table of `relit bench`, and the general solver against NumPy."""
    return [*bench(BenchRequest()), "", *search_rows()]


def depth_speed(_: argparse.Namespace) -> list[str]:
    """Measure the decoders of projected codes and of time of flight against NumPy."""
    return ["Projected codes:", "", *structured_rows(), "", "Time of flight:", "", *tof_rows()]


def demo(_: argparse.Namespace) -> list[str]:
    """Measure the seconds of `relit demo`, with and without compiled kernels."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["WARP_CACHE_PATH"] = str(Path(folder) / "kernels")
        cold, _ = _measure("demo", "--out", str(Path(folder) / "cold"))
        warm, peak = _measure("demo", "--out", str(Path(folder) / "warm"))
        del os.environ["WARP_CACHE_PATH"]
    return [f"`relit demo` takes {cold:.0f} s the first time, when its kernels are compiled, and {warm:.0f} s afterwards; "
            f"peak memory {peak:.2f} GiB."]


def _measure(*arguments: str) -> tuple[float, float]:
    """Run relit in a child process.

    Returns:
        Seconds, and peak resident memory in GiB.
    """
    before = time.perf_counter()
    code = "import resource, sys; from service.cli.main import main\n" \
           "try:\n    main()\nfinally:\n    print('peak', resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    result = subprocess.run([sys.executable, "-c", code, *arguments], check=True, capture_output=True, text=True)
    peak = int(result.stdout.split("peak")[-1])
    return time.perf_counter() - before, peak / 2**20


SECTIONS: dict[str, tuple[str, Section]] = {
    "lambert": ("Lambertian surface with cast shadows", lambert),
    "real": ("Real objects", real),
    "glossy": ("Glossy and metallic objects", glossy),
    "materials": ("Effect of sharing materials", lambda given: material_table(given.glossy, given.relighting)),
    "fresnel": ("F0 of dielectrics under Schlick's approximation", lambda given: fresnel_table(given.glossy, given.relighting)),
    "ablation": ("Effect of each part of `svbrdf`", lambda given: ablation_table(given.data, given.glossy, given.relighting)),
    "relighting": ("Relighting", lambda given: relighting_table(given.relighting)),
    "left_out": ("Real lights left out", lambda given: None if given.data is None else left_out_table(given.data)),
    "spin": ("A spin of 240 frames", lambda _: spin_table()),
    "rig": ("Depth from projected light", lambda given: None if given.rig is None else rig_table(given.rig)),
    "speed": ("Speed", speed),
    "gpu": ("On a GPU", lambda _: None),  # `python -m benchmarks.gpu --write` writes it, on a machine with a GPU
    "products": ("Products on a GPU", lambda _: None),  # `python -m benchmarks.gpu.products FOLDER --write`, on such a machine too
    "estimate": ("Estimate for a GPU", lambda _: estimate_rows()),
    "asked": ("Asked of a device", lambda _: asked_rows()),
    "registers": ("Registers of kernels", lambda _: register_rows()),
    "paired": ("Speed beside an older version", lambda given: None if given.before is None else paired_rows(given.before)),
    "tof": ("Depth from time of flight", lambda _: [*accuracy_rows(), "", *bound_rows()]),
    "depth_speed": ("Speed of depth", depth_speed),
    "demo": ("The demo", demo),
    "memory": ("Memory", lambda given: None if given.large is None else large_table(given.large, given.megapixels, given.lights,
                                                                                     given.frames)),
    "set_faults": ("Faults of captures", lambda _: fault_table()),
    "set_times": ("Time of captures", lambda _: time_table()),
    "studio": ("Charts and publications", lambda _: studio_rows()),
}
"""Title of each section, and what measures it; None: what the page says already is kept."""
INTRODUCTION = ("# Figures\n\n*After reading this page you can judge what Relit reaches on your machine: accuracy, speed and memory.*\n\n"
                "Written by `make figures` (`python -m benchmarks.figures`); each section says when and where it was "
                "measured. The times are from a machine that other work shared: ratios hold on other machines, seconds do not.\n")


def machine() -> str:
    """Return the date and the machine of the measurement."""
    return f"{date.today()}, {os.cpu_count()} CPU cores, Python {platform.python_version()}"


def main() -> None:
    """Measure the sections that can be measured here and write the file."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, help="folder with diligent_ball and diligent_cat")
    parser.add_argument("--glossy", type=Path, help="folder with glossy and glossy_metal of samples/make_glossy.py")
    parser.add_argument("--relighting", type=Path, help="folder with glossy and owl of samples/make_relight_checks.py, and "
                                                           "two_parts, figure, still, desk, carved and atelier of samples/make_parts.py")
    parser.add_argument("--rig", type=Path, help="folder with the sets of samples/make_rig.py")
    parser.add_argument("--large", type=Path, help="folder where about 40 GB may be written and are removed again")
    parser.add_argument("--before", type=Path, help="checkout of an older version, to compare the speed with")
    parser.add_argument("--megapixels", type=float, default=MEGAPIXELS, help="of --large")
    parser.add_argument("--lights", type=int, default=LIGHTS, help="of --large")
    parser.add_argument("--frames", type=int, default=FRAMES, help="of --large")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, help="sections to measure (default: all)")
    given = parser.parse_args()
    before = TARGET.read_text(encoding="utf-8") if TARGET.exists() else ""
    parts = [INTRODUCTION]
    for name, (title, section) in SECTIONS.items():
        began = time.perf_counter()
        lines = section(given) if given.only is None or name in given.only else None
        if lines is None:
            kept = re.search(rf"## {re.escape(title)}\n.*?(?=\n## |\Z)", before, flags=re.DOTALL)
            if kept is not None:
                parts.append(kept[0].rstrip() + "\n")
            continue
        print(f"{name}: {time.perf_counter() - began:.0f} s", file=sys.stderr)
        parts.append(f"## {title}\n\n" + "\n".join(lines) + f"\n\n*{machine()}*\n")
    write_text(TARGET, "\n".join(parts))


if __name__ == "__main__":
    main()
