"""The search for a colour chart in a picture: OpenCV's detector proposes its place, and the edges of its patches refine it.

Source: OpenCV's module mcc without its neural network, which groups quadrilaterals of one size and compares their colours with those of the
    chart.
"""

from collections.abc import Iterator

import cv2
import numpy as np

from service.calibrate.solvers.chart_reference import GRIDS

KINDS = {24: cv2.mcc.MCC24, 140: cv2.mcc.SG140}
ALIKE = 0.2
"""Parts of the size of a chart by which corners differ that are cut once."""
CUTS = (0.5, 0.25, 0.75)
"""Where across a found chart, and across the picture, it is cut off to look for another: parts of the way from edge to edge."""
MOST_CHARTS = 3
"""The most charts that are proposed in one picture."""
LONGEST = 1600
"""The longest side of the picture that is searched, pixels."""
WHITE_PERCENTILES = (99.5, 97.0, 88.0)
"""The percentile of the brightness that becomes white in the picture that is searched; the next is tried where no chart is found."""
CELL, MARGIN = 48, 24
"""The spacing of patches in the rectified picture, and the part of it beyond the outermost centres, pixels."""
COARSER = 1.3
"""A picture with so much larger spacings is made smaller before it is rectified."""
PATCH_AREA = (0.3, 0.96)
"""The area of a patch over the square of the spacing: less is a part of one, more is one without an edge."""
FEWEST = 0.4
"""The part of the patches whose outlines are needed to refine the place of a chart."""
FARTHEST = 0.3
"""The farthest that a corner moves as it is refined, in spacings of patches."""


def find_charts(picture: np.ndarray, patches: int) -> Iterator[np.ndarray]:
    """Yield the centres of the corner patches of what may be the chart in a picture, the likeliest first.

    The detector takes patches that lie beside a chart in the same spacing, as those of the other page of an open Passport, for some of
    its own, or finds none for them. So what it finds is followed by what it finds where the picture is cut off across each of these, and
    across the picture itself.
    `picture`: [rows, cols, 3] float32, scene-linear. Yields [4, 2] float64 pixels (u, v), the centre of the first being (0.5, 0.5): the
    first patch, the last of the first row, the last of the chart, the first of the last row, as OpenCV takes the chart to stand."""
    step = max(picture.shape[:2]) / LONGEST
    small = cv2.resize(picture, None, fx=1 / step, fy=1 / step, interpolation=cv2.INTER_AREA) if step > 1 else picture
    brightest = small.max(axis=-1)
    pictures = [np.ascontiguousarray((255 * np.clip(small / max(float(np.percentile(brightest, percentile)), 1e-9), 0, 1) ** (1 / 2.2)
                                      ).astype(np.uint8)[..., ::-1]) for percentile in WHITE_PERCENTILES]
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for shown in pictures:
        for corners in _detected(shown, patches):
            if all(np.abs(corners - other).max() > ALIKE * np.ptp(corners, axis=0).max() for _, other in found):
                found.append((shown, corners))
            yield (corners + 0.5) * max(step, 1.0)
    rows, cols = brightest.shape
    whole = np.array([[0, 0], [cols, 0], [cols, rows], [0, rows]], np.float64)
    for shown, corners in [*found, *((shown, whole) for shown in pictures)]:
        for ends in np.mean([corners, np.roll(corners, -1, axis=0)], axis=0).astype(np.float32)[[[0, 2], [2, 0], [1, 3], [3, 1]]]:
            (u, v), (y, x) = ends[1] - ends[0], np.indices(shown.shape[:2])
            along = ((x - ends[0, 0]) * u + (y - ends[0, 1]) * v) / (u * u + v * v)
            for share in CUTS:
                for part in _detected(np.where((along > share)[..., None], np.uint8(0), shown), patches):
                    yield (part + 0.5) * max(step, 1.0)


def _detected(shown: np.ndarray, patches: int) -> Iterator[np.ndarray]:
    """Yield the centres of corner patches [4, 2] that OpenCV finds in a picture as a display shows it, the likeliest first."""
    detector = cv2.mcc.CCheckerDetector.create()
    detector.setUseDnnModel(False)
    detector.setColorChartType(KINDS[patches])
    try:
        if not detector.process(shown, MOST_CHARTS):
            return
    except cv2.error:  # of some pictures it takes parts that lie outside of them
        return
    columns = GRIDS[patches][0]
    for chart in sorted(detector.getListColorChecker(), key=lambda each: each.getCost()):
        centres = np.array(chart.getColorCharts(), np.float64).reshape(-1, 4, 2).mean(axis=1)
        yield centres[[0, columns - 1, patches - 1, patches - columns]]


def refine_corners(picture: np.ndarray, corners: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """Return the centres of the corner patches [4, 2] of a chart by the outlines of all its patches; `corners` where too few are seen."""
    columns, rows = grid
    step = np.linalg.norm(corners[1] - corners[0]) / (columns - 1) / CELL
    if step > COARSER:  # as many pixels as the rectified picture has, each the mean of several, so that noise is lower
        size = round(picture.shape[1] / step), round(picture.shape[0] / step)
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        scale = np.array(picture.shape[1::-1]) / small.shape[1::-1]
        return np.asarray(refine_corners(small, corners / scale, grid) * scale)
    ends = np.array([[0, 0], [columns - 1, 0], [columns - 1, rows - 1], [0, rows - 1]], np.float32)
    places = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(np.float32)
    size = 2 * MARGIN + CELL * (columns - 1), 2 * MARGIN + CELL * (rows - 1)
    found = corners
    for _ in range(4):
        form = cv2.getPerspectiveTransform(MARGIN + CELL * ends, found.astype(np.float32) - 0.5)
        flat = cv2.warpPerspective(picture, form, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE)
        flat = cv2.GaussianBlur(flat, (0, 0), 1.0)
        centres = [_centre(flat, place) for place in MARGIN + CELL * places]
        seen = np.array([centre is not None for centre in centres])
        if seen.sum() < max(FEWEST * len(places), 6):
            return found
        there = cv2.perspectiveTransform(np.array([centre for centre in centres if centre is not None], np.float64)[None], form)[0]
        tolerance = 0.03 * float(np.linalg.norm(found[1] - found[0])) / (columns - 1)
        fitted, _ = cv2.findHomography(places[seen], there, cv2.RANSAC, tolerance)
        if fitted is None:
            return found
        better = cv2.perspectiveTransform(ends[None].astype(np.float64), fitted)[0] + 0.5
        if np.abs(better - corners).max() > FARTHEST * np.linalg.norm(corners[1] - corners[0]) / (columns - 1):
            return corners
        found = better
    return found


def _centre(flat: np.ndarray, place: np.ndarray) -> np.ndarray | None:
    """Return the centre of gravity of the patch at a place of the rectified picture; None where it has no outline."""
    u, v = place.astype(int)
    half = CELL // 2
    part = flat[max(v - half, 0) : v + half + 1, max(u - half, 0) : u + half + 1].astype(np.float64)
    top, left = min(v, half), min(u, half)
    inner = part[top - 5 : top + 6, left - 5 : left + 6].reshape(-1, 3)
    colour = np.median(inner, axis=0)
    around = np.median(np.concatenate([part[0], part[-1], part[:, 0], part[:, -1]]), axis=0)
    axis = around - colour
    contrast = float(axis @ axis)
    if contrast <= (6 * float(np.linalg.norm(inner.std(axis=0)))) ** 2:
        return None
    beyond = (part - colour) @ axis / contrast  # 0 on the patch, 1 around it
    inside = (beyond < 0.5) & (((part - colour) ** 2).sum(axis=-1) < contrast)
    _, label, stats, _ = cv2.connectedComponentsWithStats(inside.astype(np.uint8), connectivity=4)
    own = label[top, left]
    if own == 0 or not PATCH_AREA[0] * CELL**2 < stats[own, cv2.CC_STAT_AREA] < PATCH_AREA[1] * CELL**2:
        return None
    if stats[own, cv2.CC_STAT_WIDTH] == part.shape[1] or stats[own, cv2.CC_STAT_HEIGHT] == part.shape[0]:
        return None
    near = cv2.dilate((label == own).astype(np.uint8), np.ones((3, 3), np.uint8))
    weight = near * np.clip(1 - beyond, 0, 1)  # whose edges lie between pixels
    down, across = np.indices(weight.shape)
    return place + np.array([(weight * across).sum(), (weight * down).sum()]) / weight.sum() - (left, top)
