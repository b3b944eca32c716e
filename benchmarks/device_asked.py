"""What products ask of a device per megapixel, from tests/device_counts.txt, which tests compare exactly: a section of docs/figures.md."""

from collections.abc import Iterator
from typing import NamedTuple

from service.solve.height import interreflection
from tests.device_ways import HALF, LIGHTS, PATCHES, SIDES, WAYS, Row, read
from tests.emulated_device import COUNTED

NAMES = list(COUNTED)
HEAD = ("| work | stage | launches | kernels in graphs | waits | up, MB/MP | down, MB/MP | arrays of launches, MB/MP "
        "| both ways per captured byte |\n|---|---|---|---|---|---|---|---|---|")


class Asked(NamedTuple):
    """What a stage asks: numbers at the two sizes, and megabytes for each further megapixel."""

    launches: tuple[int, int]
    graphed: tuple[int, int]
    waits: tuple[int, int]
    up: float
    down: float
    touched: float

    def cells(self, captured: float) -> list[str]:
        """Return the cells of a line, where so many megabytes are captured for a megapixel."""
        counts = [f"{small}" if small == large else f"{small}, {large}" for small, large in self[:3]]
        return [*counts, *(f"{megabytes:,.1f}" for megabytes in self[3:]), f"{(self.up + self.down) / captured:.2f}"]


def asked(way: str) -> Iterator[tuple[str, Asked]]:
    """Yield the stages of a way, and all of them as one."""
    small, large = ([row for row in read() if (row.way, row.side) == (way, side)] for side in SIDES[1:])
    if [row.stage for row in small] != [row.stage for row in large]:
        raise ValueError(f"device_counts.txt has other stages of {way} at {SIDES[1]} pixels than at {SIDES[2]}")
    pixels = WAYS[way].pixels(SIDES[2]) - WAYS[way].pixels(SIDES[1])

    def between(first: list[Row], second: list[Row]) -> Asked:
        a, b = ([sum(row.counts[number] for row in rows) for number in range(len(NAMES))] for rows in (first, second))
        pairs = {name: (a[number], b[number]) for number, name in enumerate(NAMES)}
        # bytes for a pixel are megabytes for a megapixel
        return Asked(pairs["launches"], pairs["graphed"], pairs["waits"],
                     *((pairs[name][1] - pairs[name][0]) / pixels for name in ("up", "down", "touched")))

    for one, other in zip(small, large, strict=True):
        yield one.stage, between([one], [other])
    if len(small) > 1:
        yield "**all**", between(small, large)


def asked_rows() -> list[str]:
    """Return the section as lines of Markdown."""
    lines = ["Counted on the emulated device, so that these figures depend on no machine: `tests/device_counts.txt`, which tests compare "
             "with every run: exactly, but for stages that iterate to a residual, whose counts may be off by a quarter. Scenes have "
             f"{SIDES[1]} and {SIDES[2]} pixels along the shorter side; a cell with two numbers has that of each, one with one number the "
             "same at both. A graph is one launch, and the kernels in it are counted beside it. Bytes are those that each further pixel "
             f"of the larger scene asks for (MP: megapixel of the capture). The scenes of solves and relit frames have {LIGHTS} lights, a "
             f"captured pixel of them {LIGHTS * 3 * HALF} bytes. What is bounded by a number of pixels or patches (those of bounced light: "
             f"{PATCHES} here, {interreflection.PATCHES} in captures) is as much at both sizes, and so no part of these bytes. Each scene "
             "fits one batch: the numbers of launches and waits of 12 megapixels are in the section above.", "", HEAD]
    for way in WAYS:
        captured = next(row.captured for row in read() if row.way == way and row.side == SIDES[1]) / WAYS[way].pixels(SIDES[1])
        for stage, found in asked(way):
            lines.append("| " + " | ".join([f"`{way}`", stage, *found.cells(captured)]) + " |")
    return lines
