"""Roughness of the owl sample as single pixels say it, as neighbours agree on it, and in truth, as one picture, docs/materials.png.

Each title has the mean error and the part of neighbours that differ by more than JUMP.

    python -m benchmarks.material_picture
"""

import tempfile
from pathlib import Path

import numpy as np

from service.relight.sheet import write_sheet
from service.requests.solve import Materials, SolveRequest
from service.solve.solve import solve
from stage.formats import exr

OWL = Path(__file__).parents[1] / "samples" / "owl"
TARGET = Path(__file__).parents[1] / "docs" / "materials.png"
JUMP = 0.1
"""Difference in roughness between neighbours that an eye sees as speckle."""


def jumps(roughness: np.ndarray, mask: np.ndarray) -> float:
    """Return the part of the pairs of neighbours in the mask, [rows, cols], whose roughness differs by more than JUMP."""
    far = [np.abs(np.diff(roughness, axis=axis)) > JUMP for axis in (0, 1)]
    both = [mask[1:] & mask[:-1], mask[:, 1:] & mask[:, :-1]]
    return float(np.concatenate([values[inside] for values, inside in zip(far, both, strict=True)]).mean())


def main() -> None:
    """Solve the owl both ways and write the picture."""
    channels, _ = exr.read(OWL / "truth.exr")
    truth = channels["roughness.Y"].astype(np.float32)
    pictures = []
    with tempfile.TemporaryDirectory() as folder:
        for name, materials in (("each pixel", Materials.EACH_PIXEL), ("coherent", Materials.COHERENT)):
            maps = solve(SolveRequest(capture=OWL, out=Path(folder), cache=Path(folder), materials=materials)).maps
            assert maps.roughness is not None and maps.estimated is not None
            mask, found = maps.estimated, maps.roughness.astype(np.float32)
            pictures.append((f"{name}: {np.abs(found - truth)[mask].mean():.3f}, {100 * jumps(found, mask):.1f} %", found))
    pictures.append((f"truth: 0, {100 * jumps(truth, mask):.1f} %", truth))
    rows, cols = (slice(int(at.min()), int(at.max()) + 1) for at in np.nonzero(mask))
    grey = [(title, np.repeat(np.where(mask, image, 1).astype(np.float32)[rows, cols, None], 3, axis=2)) for title, image in pictures]
    write_sheet(TARGET, [grey], height=440)
    print("\n".join([title for title, _ in pictures] + [str(TARGET)]))


if __name__ == "__main__":
    main()
