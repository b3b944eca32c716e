"""Inspection of printed boards that differ as prints and sensors do (tests/scenes/printed_board.py): false alarms and faults found.

`python -m benchmarks.printed_boards` prints the table of docs/inspection.md.
"""

import argparse
import json
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service.boards.inspect_board import InspectBoardResult, inspect_board
from service.boards.inspect_paste import InspectPasteResult, inspect_paste
from service.boards.stitching.regions import Verdict
from service.requests.inspect_board import InspectBoardRequest, InspectPasteRequest
from tests.scenes.paste_layer import write_layer
from tests.scenes.printed_board import THICK, Print, measured, regions, surface, write_board

GOOD, FAULTY = 200, 20
TOLERANCE = 0.15
"""Part of the thickness by which the paste of a pad may be off."""
ELSEWHERE_M = 2.5e-5
"""Deviations that are no defect where prints differ."""
LIMITS = {"volume_percent": [85, 115], "height_percent": [75, 125], "area_percent": [85, 115], "offset_percent": 8}
"""The limits of pads by a paste layer."""
VARIED = {"spread": 0.03, "texture": 2e-6}


class Kind(NamedTuple):
    """A kind of good boards, and how they are inspected."""

    name: str
    board: Callable[[int], Print]
    options: dict[str, Any]
    with_regions: bool


def s_shaped(seed: int) -> float:
    """Half the height of an S between 2 and 5 µm."""
    return 2e-6 + 3e-6 * (seed % 7) / 6


KINDS = (
    Kind("one print measured again, no tolerance", lambda seed: Print(), {}, False),
    Kind("the same bent to an S of 2 to 5 µm, `--remove spline`", lambda seed: Print(warp=s_shaped(seed)), {"remove": "spline"}, False),
    Kind("prints that differ, bent, ± 15 % on pads", lambda seed: Print(warp=s_shaped(seed), **VARIED), {"tolerance_m": ELSEWHERE_M}, True),
)
FAULTS = {"missing": Print(missing=(5,), **VARIED), "shifted by 40 µm": Print(shift=(6, 4e-5), **VARIED),
          "20 % more": Print(volume=(2, 1.2), **VARIED), "20 % less": Print(volume=(9, 0.8), **VARIED),
          "bridge": Print(bridge=(4, 5), **VARIED)}


class Station:
    """A golden board, and boards that are inspected against it."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.golden = folder, folder / "golden" / "out"
        (folder / "golden").mkdir()
        board = write_board(folder / "golden", measured(surface(Print()), np.random.default_rng(999)))
        inspect_board(InspectBoardRequest(board=board, out=self.golden, device="cpu"))
        (folder / "regions.json").write_text(json.dumps({"schema": "relit.board-regions/1", "regions": regions(TOLERANCE)}))

        write_layer(folder / "paste.gbr")
        (folder / "limits.json").write_text(json.dumps({"schema": "relit.paste-limits/1", "classes": [{"name": "2", "limits": [LIMITS]}]}))

    def _printed(self, what: Print, seed: int) -> Path:
        random = np.random.default_rng(seed)
        place = self.folder / "board"
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        return write_board(place, measured(surface(what, random), random))

    def paste(self, what: Print, seed: int) -> InspectPasteResult:
        """Print and measure a board, and inspect its paste by the layer."""
        place = self._printed(what, seed)
        return inspect_paste(InspectPasteRequest(board=place, paste=self.folder / "paste.gbr", stencil_m=THICK, out=place / "out",
                                                 limits=self.folder / "limits.json", device="cpu"))

    def inspect(self, what: Print, seed: int, *, with_regions: bool, **options: Any) -> InspectBoardResult:
        """Print, measure and inspect a board."""
        place = self._printed(what, seed)
        more = {"regions": self.folder / "regions.json"} if with_regions else {}
        return inspect_board(InspectBoardRequest(board=place, golden=self.golden, out=place / "out", device="cpu", **more, **options))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--good", type=int, default=GOOD, help="good boards, of all kinds together")
    parser.add_argument("--faulty", type=int, default=FAULTY, help="boards with each fault")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        station = Station(Path(name))
        print("| good boards | with a false alarm | not inspected or undecided |\n|---|---|---|", flush=True)
        for number, kind in enumerate(KINDS):
            seeds = range(number, arguments.good, len(KINDS))
            found = [station.inspect(kind.board(seed), seed, with_regions=kind.with_regions, **kind.options).verdict for seed in seeds]
            alarms = sum(verdict is Verdict.FAIL for verdict in found)
            open_ = sum(verdict not in (Verdict.FAIL, Verdict.PASS) for verdict in found)
            print(f"| {kind.name} | {alarms} of {len(found)} | {open_} |", flush=True)
        alike = [station.paste(Print(warp=s_shaped(seed), **VARIED), 5000 + seed).verdict for seed in range(arguments.good)]
        print(f"| the last kind by its paste layer | {sum(verdict is Verdict.FAIL for verdict in alike)} of {len(alike)} "
              f"| {sum(verdict not in (Verdict.FAIL, Verdict.PASS) for verdict in alike)} |", flush=True)
        print("\n| fault | found | by the paste layer |\n|---|---|---|")
        for fault, what in FAULTS.items():
            verdicts = [station.inspect(what._replace(warp=s_shaped(seed)), 1000 + seed, with_regions=True, tolerance_m=ELSEWHERE_M).verdict
                        for seed in range(arguments.faulty)]
            pasted = [station.paste(what._replace(warp=s_shaped(seed)), 2000 + seed).verdict for seed in range(arguments.faulty)]
            print(f"| {fault} | {sum(verdict is Verdict.FAIL for verdict in verdicts)} of {len(verdicts)} "
                  f"| {sum(verdict is Verdict.FAIL for verdict in pasted)} of {len(pasted)} |", flush=True)


if __name__ == "__main__":
    main()
