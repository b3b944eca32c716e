"""Tiles of a board to one height map: where every tile lies, by all overlaps at once, and the blend of all."""

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from service.boards.stitching.blending import Blender, grid_points
from service.boards.stitching.grid import BoardGrid, HeightMap, HeightPatch
from service.boards.stitching.motions import Motions, solve_motions
from service.boards.stitching.overlap import UNKNOWNS, Evidence, Overlap, choose_candidate, measure_overlap
from service.boards.stitching.trends import trend_sentences
from stage.errors import BoardError

SEARCH_SIGMA = 3.0
"""The search for a shift reaches this many standard deviations of the difference of two positions."""
SHIFT_SIGMA_PX = 5.0
"""The standard deviation of the stage's position, pixels, where the scan does not say it."""
TURN_SIGMA_DEGREES = 0.1
"""The standard deviation of a tile's rotation, degrees, where the scan does not say it."""
MIRRORED_CORRELATION, MIRRORED_NOISE = 0.9, 2.0
"""A tile is mirrored if its mirror image correlates with its neighbour at least so well, with residuals of at most so many times the
noise, and itself does not fit."""
LEAST_PART = 0.5
"""Overlaps are measured if they have at least this part of the largest overlap of one of their tiles: a corner says little."""
FAR_SIGMA = 5.0
NOISIER = 1.3
"""The factor from which on noise is said to be more than the σ of the depths, or that of other tiles."""
MILLI = 1000.0


class TilePoints(NamedTuple):
    """The measured points of a tile at the pose that the stage tells."""

    name: str
    x: np.ndarray  # [n] float32 metres from `origin`, board frame
    y: np.ndarray
    z: np.ndarray
    sigma: np.ndarray  # [n] float32 metres, of z
    origin: np.ndarray  # [3] float64 metres
    pixel_m: float
    """The distance of neighbouring points."""
    used: np.ndarray
    """[rows, cols] bool: the pixels of the points."""

    def moved(self, motion: np.ndarray, *, centre: tuple[float, float], length_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return x, y and z after a motion, [n] float64 metres."""
        x, y, z = (values.astype(np.float64) + start for values, start in zip((self.x, self.y, self.z), self.origin, strict=True))
        right, up = (x - centre[0]) / length_m, (y - centre[1]) / length_m
        return x + motion[0] - motion[2] * up, y + motion[1] + motion[2] * right, z + motion[3] + motion[4] * right + motion[5] * up

    @property
    def middle(self) -> np.ndarray:
        """Return the middle of the tile, [x, y] metres."""
        return self.origin[:2] + [(float(v.min()) + float(v.max())) / 2 for v in (self.x, self.y)]

    @property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest [x, y] in metres."""
        ends = np.array([[values.min(), values.max()] for values in (self.x, self.y)], dtype=np.float64)
        return self.origin[:2] + ends[:, 0], self.origin[:2] + ends[:, 1]


class Stitched(NamedTuple):
    """The positions of the tiles of a board, and their agreement."""

    grid: BoardGrid
    centre: tuple[float, float]
    length_m: float
    """L of the motions: half of the larger side of the board."""
    motions: Motions
    overlaps: dict[tuple[int, int], Overlap]
    noise_factor: float
    """Noise over σ of the depths; 1 or more, and 1 for a single tile."""
    tile_noise: np.ndarray
    """[tiles] the same for each tile, which is more where all of its overlaps are noisier than others."""
    shared_m: float
    """Standard deviation of the error of a tile that the pixels of a block share, with the heights by which overlaps differ still."""
    warnings: list[str]


def stitch(
    tiles: Sequence[TilePoints], *,
    shift_sigma_m: float | None = None,  # standard deviation of the stage's positions, metres; None: SHIFT_SIGMA_PX pixels
    turn_sigma_degrees: float | None = None,  # standard deviation of the rotation of tiles; None: TURN_SIGMA_DEGREES
    pixel_m: float | None = None,  # side of the grid's pixels; None: the largest distance of neighbouring points of a tile
    progress: Callable[[float], None] = lambda share: None,  # called with the share of the overlaps that have been measured, 0 to 1
) -> Stitched:
    """Find where every tile lies.
    Raises BoardError if a tile overlaps no other, is mirrored, shows another surface, or several shifts of tiles fit alike."""
    pixel = pixel_m or max(tile.pixel_m for tile in tiles)
    shift_sigma = shift_sigma_m or SHIFT_SIGMA_PX * pixel
    turn_sigma = np.radians(TURN_SIGMA_DEGREES if turn_sigma_degrees is None else turn_sigma_degrees)
    search = max(1, int(np.ceil(SEARCH_SIGMA * np.sqrt(2) * shift_sigma / pixel)))
    low = np.min([tile.corners[0] for tile in tiles], axis=0)
    high = np.max([tile.corners[1] for tile in tiles], axis=0)
    neighbours = _neighbours(tiles, SEARCH_SIGMA * shift_sigma)
    _check_neighbours(tiles, neighbours)
    margin = SEARCH_SIGMA * shift_sigma + pixel
    grid = BoardGrid.around(low - margin, high + margin, pixel)
    centre, length = (float(low[0] + high[0]) / 2, float(low[1] + high[1]) / 2), float(max(high - low)) / 2
    middles = np.array([tile.middle for tile in tiles]) - centre
    motions = Motions(np.zeros((len(tiles), UNKNOWNS)), np.zeros((UNKNOWNS * len(tiles),) * 2), (), 0.0)
    overlaps: dict[tuple[int, int], Overlap] = {}
    done = 0
    for final in (False, True) if len(tiles) > 1 else ():
        patches = [_patch(tile, motion, grid, centre, length) for tile, motion in zip(tiles, motions.values, strict=True)]
        found: dict[tuple[int, int], Overlap] = {}
        for i, j in neighbours:
            flat = final and ((i, j) not in overlaps or overlaps[i, j].evidence is not Evidence.SHIFT)
            overlap = measure_overlap(patches[i], patches[j], grid, centre=centre, length_m=length,
                                      shift_sigma_m=shift_sigma * np.sqrt(2), search_px=0 if final else search)
            done += 1
            progress(done / (2 * len(neighbours)))
            if overlap is None or (final and (i, j) in overlaps and overlaps[i, j].evidence is Evidence.DIFFERS):
                continue
            if flat and overlap.evidence is Evidence.SHIFT:
                information = overlap.information.copy()
                information[:3], information[:, :3] = 0, 0
                overlap = overlap._replace(evidence=Evidence.FLAT, information=information)
            found[i, j] = overlap._replace(difference=overlap.difference + motions.values[i] - motions.values[j])
        overlaps = found if not final else {**{pair: o for pair, o in overlaps.items() if o.evidence is Evidence.DIFFERS}, **found}
        _check_agreement(tiles, overlaps, patches, motions, grid, centre, length, shift_sigma, search)
        motions = _solve(tiles, overlaps, middles, length, pixel, shift_sigma, turn_sigma)
    used = [overlap for overlap in overlaps.values() if overlap.evidence is not Evidence.DIFFERS]
    noise = max(1.0, float(np.median([overlap.noise_factor for overlap in used]))) if used else 1.0
    shared = float(np.sqrt(np.mean([overlap.shared_m**2 for overlap in used]) + motions.misfit_m**2)) if used else 0.0
    each = _tile_noise(overlaps, len(tiles), noise)
    measured = _measured(overlaps, motions)
    said = [*_warnings(tiles, overlaps, measured, motions, noise, each), *_far(tiles, motions, middles / length, shift_sigma),
            *trend_sentences(middles, motions, np.isin(np.arange(len(tiles)), list(measured)), length_m=length, pixel_m=pixel,
                             tile_m=float(np.median([max(tile.corners[1] - tile.corners[0]) for tile in tiles])) / 2,
                             sigma_m=noise * float(np.median([np.median(tile.sigma) for tile in tiles])))]
    return Stitched(grid, centre, length, motions, overlaps, noise, each, shared, said)


def blend(tiles: Sequence[TilePoints], stitched: Stitched, grid: BoardGrid, *, motion: np.ndarray | None = None,
          relief: np.ndarray | None = None, progress: Callable[[int], None] = lambda done: None) -> HeightMap:
    """Return the height map of all tiles. `motion`: [6] a motion of the whole board; None: none. `relief`: as in Blender."""
    return blended(tiles, stitched, grid, motion=motion, relief=relief, progress=progress).result()


def blended(tiles: Sequence[TilePoints], stitched: Stitched, grid: BoardGrid, *, motion: np.ndarray | None = None,
            relief: np.ndarray | None = None, progress: Callable[[int], None]) -> Blender:
    """Return the sums of all tiles, which have their errors too; arguments are those of `blend`."""
    blender = Blender(grid, centre=stitched.centre, length_m=stitched.length_m, relief=relief)
    whole = np.zeros(UNKNOWNS) if motion is None else motion
    for number, tile in enumerate(tiles):
        patch = _patch(tile, stitched.motions.values[number] + whole, grid, stitched.centre, stitched.length_m)
        blender.add(patch, stitched.motions.of_tile(number), stitched.shared_m, noise_factor=float(stitched.tile_noise[number]))
        progress(number + 1)
    return blender


def _patch(tile: TilePoints, motion: np.ndarray, grid: BoardGrid, centre: tuple[float, float], length_m: float, *,
           mirrored: bool = False) -> HeightPatch:
    if mirrored:
        tile = tile._replace(x=(float(tile.x.min()) + float(tile.x.max())) - tile.x)
    return grid_points(*tile.moved(motion, centre=centre, length_m=length_m), tile.sigma, grid)


def _neighbours(tiles: Sequence[TilePoints], margin: float) -> list[tuple[int, int]]:
    """Return the pairs of tiles whose rectangles may overlap, given an error of the stage, without those that share a mere corner."""
    corners = [tile.corners for tile in tiles]
    sides = {(i, j): np.minimum(corners[i][1], corners[j][1]) - np.maximum(corners[i][0], corners[j][0]) + margin
             for i, j in combinations(range(len(tiles)), 2)}
    areas = {pair: float(side.prod()) for pair, side in sides.items() if (side > 0).all()}
    largest = [max((area for pair, area in areas.items() if tile in pair), default=0.0) for tile in range(len(tiles))]
    return [pair for pair, area in areas.items() if area >= LEAST_PART * min(largest[pair[0]], largest[pair[1]])]


def _check_neighbours(tiles: Sequence[TilePoints], neighbours: list[tuple[int, int]]) -> None:
    """Refuse a tile that lies beside all others; say so where positions look like millimetres."""
    if len(tiles) == 1:
        return
    joined = {tile for pair in neighbours for tile in pair}
    alone = next((number for number in range(len(tiles)) if number not in joined), None)
    if alone is None:
        return
    tile = tiles[alone]
    low, high = tile.corners
    others = np.array([other.middle for number, other in enumerate(tiles) if number != alone])
    nearest = float(np.hypot(*(others - tile.middle).T).min())
    size = max(high - low)
    hint = ""
    if nearest / MILLI < 1.2 * size:
        hint = ": give positions in metres, these look like millimetres"
    elif nearest > 100 * size:
        hint = ": check the positions and their unit, which is the metre"
    raise BoardError(f"tile {tile.name}: overlaps no other tile: it is {size:.3g} m wide, and the middle of the nearest is {nearest:.3g} m "
                     f"away{hint}")


def _check_agreement(tiles: Sequence[TilePoints], overlaps: dict[tuple[int, int], Overlap], patches: list[HeightPatch], motions: Motions,
                     grid: BoardGrid, centre: tuple[float, float], length_m: float, shift_sigma_m: float, search_px: int) -> None:
    """Refuse tiles that no overlap joins with the others; say so where one is mirrored."""
    joined = [pair for pair, overlap in overlaps.items() if overlap.evidence is not Evidence.DIFFERS]
    differs = [pair for pair, overlap in overlaps.items() if overlap.evidence is Evidence.DIFFERS]
    contrary = [sum(tile in pair for pair in differs) - sum(tile in pair for pair in joined) for tile in range(len(tiles))]
    if differs:
        turned = max({tile for pair in differs for tile in pair}, key=lambda tile: contrary[tile])
        mirrored = _patch(tiles[turned], motions.values[turned], grid, centre, length_m, mirrored=True)
        others = [i + j - turned for i, j in differs if turned in (i, j)]
        seen = [measure_overlap(patches[other], mirrored, grid, centre=centre, length_m=length_m, shift_sigma_m=shift_sigma_m * np.sqrt(2),
                                search_px=search_px) for other in others]
        if all(each is not None and each.correlation >= MIRRORED_CORRELATION and each.noise_factor <= MIRRORED_NOISE for each in seen):
            if len(tiles) == 2:
                raise BoardError(f"tiles {tiles[0].name} and {tiles[1].name}: one of them is mirrored: its mirror image fits the other, "
                                 "itself does not")
            raise BoardError(f"tile {tiles[turned].name}: is mirrored: its mirror image fits tile {tiles[others[0]].name}, itself does not")
    first, second = np.array(joined, dtype=np.int64).reshape(-1, 2).T
    count, group = connected_components(coo_array((np.ones(len(joined)), (first, second)), shape=(len(tiles),) * 2), directed=False)
    if count == 1:
        return
    apart = next(number for number in range(len(tiles)) if group[number] != group[0])
    pair = next((pair for pair in differs if group[pair[0]] != group[pair[1]]), None)
    if pair is not None:
        raise BoardError(f"tiles {tiles[pair[0]].name} and {tiles[pair[1]].name}: do not show the same surface where they overlap "
                         f"(correlation of their heights {overlaps[pair].correlation:.2f}): check their positions")
    raise BoardError(f"tile {tiles[apart].name}: has too few pixels in common with the other tiles: let tiles overlap by more")


def _solve(tiles: Sequence[TilePoints], overlaps: dict[tuple[int, int], Overlap], middles: np.ndarray, length_m: float, pixel_m: float,
           shift_sigma_m: float, turn_sigma: float) -> Motions:
    """Solve for the motions, and settle overlaps that repeat by what the others say; `overlaps` takes what is settled.
    Raises BoardError if several shifts fit alike, and nothing tells which is right."""
    def solved() -> Motions:
        return solve_motions(overlaps, middles, length_m=length_m, pixel_m=pixel_m, shift_sigma_m=shift_sigma_m, turn_sigma=turn_sigma)

    motions = solved()
    while repeating := [pair for pair, overlap in overlaps.items() if overlap.evidence is Evidence.REPEATS]:
        settled = {}
        for i, j in repeating:
            expected = motions.values[i, :2] - motions.values[j, :2]
            parts = [slice(UNKNOWNS * tile, UNKNOWNS * tile + 2) for tile in (i, j)]
            a, b = parts
            covariance = motions.covariance[a, a] + motions.covariance[b, b] - motions.covariance[a, b] - motions.covariance[b, a]
            chosen = choose_candidate(overlaps[i, j], expected, covariance + (0.1 * pixel_m) ** 2 * np.eye(2))
            if chosen is not None:
                settled[i, j] = chosen
        if not settled:
            i, j = repeating[0]
            several = overlaps[i, j].candidates
            away = float(np.hypot(*(several[1].difference[:2] - several[0].difference[:2])))
            raise BoardError(f"tiles {tiles[i].name} and {tiles[j].name}: shifts that differ by {away:.3g} m fit alike, because the board "
                             "repeats itself there, and the positions of the stage do not tell them apart: give stage_sigma_m if the stage "
                             "is more exact, or let the tiles overlap where the board does not repeat")
        overlaps.update(settled)
        motions = solved()
    return motions


def _tile_noise(overlaps: dict[tuple[int, int], Overlap], count: int, noise: float) -> np.ndarray:
    """Return the noise of each tile over σ of its depths, [tiles]: the least that its overlaps leave to it beside the least noisy tile,
    and that of all tiles at the least. An overlap has the mean square of its two tiles' factors."""
    factors = {pair: max(overlap.noise_factor, 1.0) for pair, overlap in overlaps.items() if overlap.evidence is not Evidence.DIFFERS}
    quietest = min(factors.values(), default=1.0)
    own = [min((factor for pair, factor in factors.items() if tile in pair), default=quietest) for tile in range(count)]
    return np.maximum(noise, np.sqrt(2 * np.square(own) - quietest**2))


def _far(tiles: Sequence[TilePoints], motions: Motions, middles: np.ndarray, shift_sigma_m: float) -> list[str]:
    """Return a sentence for each tile that lies farther from its position than FAR_SIGMA, less the median of all tiles."""
    shifts = motions.values[:, :2] + motions.values[:, 2:3] * np.stack([-middles[:, 1], middles[:, 0]], axis=1)
    away = np.hypot(*(shifts - np.median(shifts, axis=0)).T)
    return [f"tile {tile.name} lies {distance:.3g} m from where the stage says, whose σ is {shift_sigma_m:.3g} m: check its position"
            for tile, distance in zip(tiles, away, strict=True) if distance > FAR_SIGMA * shift_sigma_m]


def _measured(overlaps: dict[tuple[int, int], Overlap], motions: Motions) -> set[int]:
    """Return the tiles whose shift an overlap tells."""
    return {tile for pair, overlap in overlaps.items() if overlap.evidence is Evidence.SHIFT and pair not in motions.contradicted
            for tile in pair}


def _warnings(tiles: Sequence[TilePoints], overlaps: dict[tuple[int, int], Overlap], measured: set[int], motions: Motions, noise: float,
              tile_noise: np.ndarray) -> list[str]:
    found = []
    if len(tiles) == 1:
        return ["there is a single tile: no overlap checks its noise or the errors that its pixels share"]
    for (i, j), overlap in overlaps.items():
        if overlap.evidence is Evidence.DIFFERS:
            found.append(f"tiles {tiles[i].name} and {tiles[j].name} do not show the same surface where they overlap (correlation "
                         f"{overlap.correlation:.2f}): their overlap is not used")
    for i, j in motions.contradicted:
        found.append(f"tiles {tiles[i].name} and {tiles[j].name}: the other overlaps contradict the shift of theirs, which is not used")
    placed = [tile.name for number, tile in enumerate(tiles) if number not in measured]
    if placed:
        found.append(f"{len(placed)} of {len(tiles)} tiles have too little relief in their overlaps to measure a shift "
                     f"({', '.join(placed[:5])}{' …' if len(placed) > 5 else ''}): they lie where the stage says")
    if noise > NOISIER:
        found.append(f"the noise of the tiles is {noise:.2f} times what the σ of their depths says: every σ is larger by that")
    noisy = [(tile.name, factor) for tile, factor in zip(tiles, tile_noise, strict=True) if factor > NOISIER * noise]
    if noisy:
        found.append("the noise of " + ", ".join(f"tile {name} is {factor:.2f} times" for name, factor in noisy[:5])
                     + f"{' …' if len(noisy) > 5 else ''} what the σ of its depths says: its σ is larger by that")
    return found
