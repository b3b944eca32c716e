"""docs/views.png: the shipped owl under every fourth of its lights at once, through two views and a look, and as LogC4.

`make screenshots` draws it.
"""

import tempfile
from pathlib import Path

import numpy as np
import PyOpenColorIO as ocio

from service.relight.sheet import AS_EVER, EXPOSURE_PERCENTILE, EXPOSURE_TARGET, display, read_frame, write_sheet
from stage.colour.colour import convert, linearise
from stage.colour.colour_spaces import Review
from stage.colour.configuration import used

HOME = Path(__file__).parents[2]
STUDIO, LOG = "ocio://studio-config-latest", "ARRI LogC4"
VIEW, LOOK = "sRGB - Display/Un-tone-mapped", "shot grade"


def main() -> None:
    """Show one picture in each way, exposed alike."""
    frames = [read_frame(path) for path in sorted((HOME / "samples" / "owl").glob("[0-9]*.exr"))[::4]]
    pixels, space = sum(radiance for radiance, _ in frames), frames[0][1]
    pixels = pixels * EXPOSURE_TARGET / np.percentile(pixels[pixels.any(axis=-1)], EXPOSURE_PERCENTILE)
    with tempfile.TemporaryDirectory() as name:
        show = Path(name, "show.ocio")
        show.write_text(_graded())
        with used(str(show)):
            graded = display(pixels, space, Review(None, LOOK))
    with used(STUDIO):
        shown, plain = display(pixels, space), display(pixels, space, Review(VIEW))
        stored = convert(pixels, space, LOG)
        again = display(linearise(stored, LOG), "Linear ARRI Wide Gamut 4", AS_EVER)
    pictures = [("ACES 2.0, the default", shown), (f"--view {VIEW.partition('/')[2]}", plain), (f"--look {LOOK}", graded),
                (f"stored as {LOG}", stored), (f"read as {LOG}", again)]
    write_sheet(HOME / "docs" / "views.png", [pictures], height=256)


def _graded() -> str:
    """Return the built-in configuration with a look that is warm and strong, as a show has it."""
    config = ocio.Config.CreateFromFile(STUDIO)
    grade = ocio.CDLTransform()
    grade.setSlope([1.05, 1.0, 0.93])
    grade.setSat(1.2)
    config.addLook(ocio.Look(name=LOOK, processSpace="ACEScct", transform=grade))
    return str(config.serialize())


if __name__ == "__main__":
    main()
