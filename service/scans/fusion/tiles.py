"""A fused surface as tiles, one for each brick, of which few are in memory at one time."""

from collections.abc import Callable
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels.fusion.bricks import BRICK_VOXELS, MEMORY_BOUND
from service.asset.usd.fused_asset import SITE_FILE, Tile, remove_other_tiles, write_site, write_tile
from service.scans.fusion.fused_bricks import SEEN_BY, FusedBricks, short
from service.scans.fusion.fused_surface import VERTEX, BrickSurface, Tally, triangle_mesh
from service.scans.fusion.holes import area_vectors
from stage.results.mesh import write_mesh_ply

TILES = "tiles"
LATTICE = 1 << 19
"""Voxels lie within so many of the origin along each axis."""
SIGMA_BINS = np.geomspace(1e-7, 10.0, 4001)
"""Bounds, metres, between which σ of vertices are counted: half a per cent apart."""


class WrittenTiles(NamedTuple):
    """The files of a tiled surface, and what the report says of it."""

    path: Path
    facts: dict[str, Any]
    tallies: list[Tally]


class _Rim(NamedTuple):
    """The vertices of a brick that others may have too."""

    edge: np.ndarray  # [n, 4] int32
    vertices: dict[str, np.ndarray]


def write_tiles(fused: FusedBricks, out: Path, *, name: str, provenance: dict[str, str], advance: Callable[[int], None]) -> WrittenTiles:
    """Write the bricks of a fusion as site.usda, which has each as a payload, tiles/X_Y_Z.usdc, and beside it as tiles/X_Y_Z.ply.

    Convention:
        A vertex on the border of bricks has the same place, normal, colour, σ and count of scans in each of their tiles.
    """
    rims: dict[tuple[int, ...], _Rim] = {}
    tiles: list[Tile] = []
    tallies = [Tally() for _ in fused.used]
    open_edges: list[tuple[np.ndarray, np.ndarray]] = []
    vertices = shared = blocks = 0
    sigma = np.zeros(len(SIGMA_BINS) - 1, dtype=np.int64)
    seen = np.zeros(max(SEEN_BY) + 1)
    faces, area = 0, 0.0
    for done, (place, brick) in enumerate(zip(fused.places, fused.bricks(), strict=True)):
        advance(done)
        here = (int(place[0]), int(place[1]), int(place[2]))
        for number, numbers in brick.tallies.items():
            tallies[number].add_numbers(numbers)
        blocks += brick.blocks
        if not len(brick.faces):
            continue
        brick, taken = _with_the_rims_of_others(brick, here, rims)
        rims = {other: rim for other, rim in rims.items() if other[0] >= here[0] - 1}
        border = np.flatnonzero((brick.edge[:, :3] % BRICK_VOXELS == 0).any(axis=1))
        rims[here] = _Rim(brick.edge[border], {each: getattr(brick, each)[border] for each in VERTEX})
        vertices, shared, faces = vertices + len(brick.points), shared + taken, faces + len(brick.faces)
        sigma += np.histogram(np.clip(brick.sigma, SIGMA_BINS[0], SIGMA_BINS[-1]), SIGMA_BINS)[0]
        of_faces = np.linalg.norm(area_vectors(brick.points, brick.faces), axis=1) / 2
        area += float(of_faces.sum())
        seen += np.bincount(np.minimum(brick.seen[brick.faces].min(axis=1), max(SEEN_BY)), of_faces, minlength=len(seen))
        open_edges.append(_open_edges(brick))
        mesh = triangle_mesh(brick, fused.names)
        stem = "_".join(map(str, here))
        write_mesh_ply(mesh, out / TILES / f"{stem}.ply", comments=(f"made by relit fuse from {name}", "coordinates in metres"))
        tiles.append(write_tile(mesh, out / TILES / f"{stem}.usdc"))
    count, length = _border(open_edges)
    facts = {"voxel_m": fused.voxel, "shared_sigma_m": None if fused.shared_sigma is None else short(fused.shared_sigma),
             "bricks": len(fused.places), "tiles": len(tiles), "blocks": blocks,
             "brick_memory_bound_bytes": MEMORY_BOUND, "vertices": vertices - shared, "faces": faces}
    if not tiles:
        return WrittenTiles(out / SITE_FILE, facts, tallies)
    write_site(tiles, out / SITE_FILE, name=name, provenance=provenance)
    remove_other_tiles(out / TILES, tiles)
    ranks = np.cumsum(sigma) / sigma.sum()
    facts |= {"sigma_m": {part: short(SIGMA_BINS[np.searchsorted(ranks, rank)]) for part, rank in (("median", 0.5), ("p95", 0.95))},
              "area_m2": short(area), "area_share_seen_by": {str(least): round(float(seen[least:].sum() / area), 4) for least in SEEN_BY},
              "open_edges": count, "open_length_m": short(length)}
    return WrittenTiles(out / SITE_FILE, facts, tallies)


def _with_the_rims_of_others(brick: BrickSurface, here: tuple[int, int, int], rims: dict[tuple[int, ...], _Rim]
                             ) -> tuple[BrickSurface, int]:
    """Return a brick whose vertices are those of an earlier brick where that has them, and how many these are."""
    given = {name: getattr(brick, name).copy() for name in VERTEX}
    own, taken = _keys(brick.edge, here), np.zeros(len(brick.edge), dtype=bool)
    for step in product((-1, 0, 1), repeat=3):  # ascending, as bricks are
        other = rims.get(tuple(np.add(here, step).tolist()))
        if step >= (0, 0, 0) or other is None or not len(other.edge):
            continue
        theirs = _keys(other.edge, here)
        order = np.argsort(theirs)
        at = order[np.minimum(np.searchsorted(theirs, own, sorter=order), len(order) - 1)]
        same = (theirs[at] == own) & ~taken
        for name, values in given.items():
            values[same] = other.vertices[name][at[same]]
        taken |= same
    return brick._replace(**given), int(taken.sum())


def _keys(edge: np.ndarray, here: tuple[int, int, int]) -> np.ndarray:
    """Return a number for each edge of the lattice in or beside a brick."""
    local = edge[:, :3].astype(np.int64) - (np.array(here) - 1) * BRICK_VOXELS
    side = 3 * BRICK_VOXELS + 1
    return np.asarray(((local[:, 0] * side + local[:, 1]) * side + local[:, 2]) * 3 + edge[:, 3])


def _open_edges(brick: BrickSurface) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges that one face of a brick alone has, [n, 2] int64 numbers of the lattice edges of their ends, and lengths [n]."""
    start, end = brick.faces.ravel().astype(np.int64), np.roll(brick.faces, -1, axis=1).ravel().astype(np.int64)
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, first, times = np.unique(low * len(brick.points) + high, return_index=True, return_counts=True)
    low, high = low[first[times == 1]], high[first[times == 1]]
    x, y, z = brick.edge[:, :3].astype(np.int64).T + LATTICE
    axis = brick.edge[:, 3]
    number = ((x * 2 * LATTICE + y) * 2 * LATTICE + z) * 3 + axis
    ends = np.sort(np.stack([number[low], number[high]], axis=1), axis=1)
    return ends, np.linalg.norm(brick.points[low] - brick.points[high], axis=1)


def _border(found: list[tuple[np.ndarray, np.ndarray]]) -> tuple[int, float]:
    """Return the number and the length of the edges that no two bricks have."""
    if not found:
        return 0, 0.0
    ends, lengths = (np.concatenate(parts) for parts in zip(*found, strict=True))
    order = np.lexsort(ends.T)
    new = np.append(True, (np.diff(ends[order], axis=0) != 0).any(axis=1))
    first = np.flatnonzero(new)
    alone = order[first[np.diff(first, append=len(order)) == 1]]
    return len(alone), float(lengths[alone].sum())
