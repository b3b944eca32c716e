"""The kernels on a GPU against the speed of its memory: `make gpu-bench`, which needs nothing but the checkout, Warp and NumPy.

    python -m benchmarks.gpu                # cuda:0
    python -m benchmarks.gpu --device cpu   # the same table on the CPU
    python -m benchmarks.gpu --write        # put the table into docs/figures.md

First the kernels are compared with NumPy twins; no speed is printed of a device on which one is wrong. Where torch is installed, its
products of the same stack are timed in the same run. Bytes are those that the work must read or write once; `of copy` is their rate over
that of a copy on the device. It fits a card of 8 GB and a host of 16 GB.
"""

import argparse
import re
import sys
from datetime import date
from pathlib import Path

import warp as wp

from benchmarks.gpu import checks, work
from kernels import device as devices
from kernels.errors import DeviceError

FIGURES, HEADING = Path(__file__).resolve().parents[2] / "docs" / "figures.md", "## On a GPU"


def put_section(heading: str, lines: list[str]) -> None:
    """Put a section into docs/figures.md, in place of an older one."""
    text = FIGURES.read_text(encoding="utf-8")
    older = re.search(rf"{heading}\n.*?(?=\n## |\Z)", text, re.DOTALL)
    section = "\n".join([heading, "", *lines]) + "\n"
    FIGURES.write_text(text.replace(older.group(), section) if older else f"{text.rstrip()}\n\n{section}", encoding="utf-8")


def main(arguments: list[str] | None = None) -> int:
    """Compare the kernels with their twins, then measure; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="cuda:0", help="cuda:0 (default), another device, or cpu")
    parser.add_argument("--write", action="store_true", help="put the table into docs/figures.md")
    args = parser.parse_args(arguments)
    try:
        device = devices.resolve(args.device)
    except DeviceError as error:
        print(error, file=sys.stderr)
        return 1
    faults = list(checks.wrong(device))
    if faults:
        faults.append(f"{len(faults)} of {len(checks.CHECKS)} kernels are wrong on {device}: nothing is measured")
        print(*faults, sep="\n", file=sys.stderr)
        return 1
    head = f"{devices.describe(device)}, {work.LIGHTS} lights, Warp {wp.__version__}; {len(checks.CHECKS)} kernels agree with NumPy."
    print(head)
    lines = [f"{head} Medians of {work.REPEATS} runs in one process.", "", *work.measure(device), "", f"*{date.today().isoformat()}*"]
    if args.write:
        put_section(HEADING, lines)
    return 0


if __name__ == "__main__":
    sys.exit(main())
