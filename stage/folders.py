"""Folders: the order of the names in them, and what one holds that was given where something else is expected."""

import re
from collections.abc import Iterable
from pathlib import Path

KNOWN = {
    "scan.json": "the shots of a scanning laser, which `relit scan` measures",
    "scan-set.json": "a scan set, which `relit register` and `relit fuse` take",
    "board.json": "the tiles of a board, which `relit inspect-board` takes",
    "board.exr": "an inspected board, which `relit gauge-board` takes",
    "capture.json": "a capture, which `relit solve` or `relit depth` takes: `relit info` tells which",
    "sequence.json": "a sequence of captures or of their results, which `relit solve`, `relit depth` and `relit export` take",
    "maps.exr": "solved maps, a result of `relit solve`, which `relit export`, `relit shade` and `relit join` take",
    "depth.exr": "a depth, a result of `relit depth`, which `relit export` and `relit join` take",
    "mesh.ply": "a surface of several scans, a result of `relit fuse`, which `relit compare` takes; it needs no export: "
                "asset.usdc beside it is the asset, with textures",
    "site.usda": "a surface in tiles, a result of `relit fuse --tiles`: it needs no export",
    "deviations.ply": "a result of `relit compare`",
    "points.usdc": "a cloud of points, a result of `relit scan`: it needs no export",
    "separation.exr": "direct and global light, a result of `relit separate`",
}
"""What the file of each name is, and which commands take a folder with it; the first that is there tells."""


def natural_order(names: Iterable[str]) -> list[str]:
    """Return names in the order in which people count: 2 before 10."""
    return sorted(sorted(names), key=lambda name: [(0, int(part), "") if part.isdecimal() else (1, 0, part.lower())
                                                   for part in re.split(r"(\d+)", name)])


def advice(folder: Path, otherwise: str, *, of_result: bool = False) -> str:
    """Return what to do with a folder that lacks what was expected: what it holds where that is known, else other words.
    `of_result`: whether a result was expected, which the other words tell how to make of a capture."""
    found = next((name for name in KNOWN if folder.is_dir() and (folder / name).is_file()), None)
    if of_result and found == "capture.json":
        return otherwise
    return otherwise if found is None else f"it holds {found}, {KNOWN[found]}"
