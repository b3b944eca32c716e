"""Depth and normals joined, against either alone: the table of docs/joining.md.

python -m benchmarks.joining [--write docs/joining.md]

Surfaces with a closed form (tests/scenes/joined.py), normals with white noise and a smooth error, depths with white noise, a tenth of
them missing. All pixels count.
"""

import argparse
from pathlib import Path

import numpy as np

from benchmarks.file_mutations import write_between
from service.joining.depth_and_normals import join_depth
from service.light_estimation.lambertian import degrees_between
from tests.scenes.joined import MM, drifting, see

CASES = ((0.5, 0.0, 0.5), (0.5, 2.0, 0.5), (0.2, 4.0, 2.0), (2.0, 3.0, 0.1))
"""Noise and smooth error of the normals in degrees, noise of the depth in millimetres."""
START, END = "<!-- made by benchmarks.joining -->", "<!-- end -->"


def table() -> str:
    """Return the table in Markdown."""
    lines = ["| surface | camera | normals: noise, drift | depth: noise | depth alone, RMS | joined where there is a depth, RMS | "
             "joined everywhere, RMS | 99 % | σ of it, RMS | normals given | joined | pixels kept as unsure |",
             "|---|---|---|---|---|---|---|---|---|---|---|"]
    for shape in ("wave", "disc"):
        for perspective in (False, True):
            view = see(shape, perspective=perspective)
            seen = np.random.default_rng(3).random(view.z.shape) > 0.1
            for noise, drift, sigma in CASES:
                given = drifting(view.normal, noise=noise, drift=drift)
                depth = -view.z + sigma * MM * np.random.default_rng(1).standard_normal(view.z.shape)
                joined = join_depth(given, np.full(view.z.shape, np.radians(noise)), np.ones(view.z.shape, dtype=bool), depth,
                                    np.full(view.z.shape, sigma * MM), seen, view.x, view.y, perspective=perspective, device="cpu")
                error = (joined.height - view.z) / MM
                unsure = joined.guessed | joined.rejected | ~joined.placed
                lines.append(
                    f"| {shape} | {'perspective' if perspective else 'orthographic'} | {noise:g}°, {drift:g}° | {sigma:g} mm | "
                    f"{np.sqrt((((depth + view.z) / MM)[seen] ** 2).mean()):.3f} mm | {np.sqrt((error[seen] ** 2).mean()):.3f} mm | "
                    f"{np.sqrt((error**2).mean()):.3f} mm | "
                    f"{np.quantile(np.abs(error), 0.99):.3f} mm | {np.sqrt((joined.sigma**2).mean()) / MM:.3f} mm | "
                    f"{degrees_between(given, view.normal).mean():.2f}° | {degrees_between(joined.normal, view.normal).mean():.2f}° | "
                    f"{unsure.mean():.2%} |")
    return "\n".join(lines)


def main() -> None:
    """Print the table, or write it into the document."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", type=Path, help="the document that the table goes into")
    arguments = parser.parse_args()
    write_between(arguments.write, START, END, table())


if __name__ == "__main__":
    main()
