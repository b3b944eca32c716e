"""Active stereo: how right and how sure every pixel is, and how fast, with OpenCV's semi-global matcher on the same images in the same run.

`python -m benchmarks.stereo` prints the figures of docs/active_stereo.md. The depth of the scenes has a closed form: every pixel of the
camera counts. Speed is that of a pair of one megapixel with 128 disparities, from rectified images to disparity and σ.
"""

import sys
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from benchmarks.timing import run_seconds
from kernels import device as devices
from kernels.status import Status
from kernels.structured.pattern_frames import NoiseModel
from service.depth.stereo.rectification import RectifiedFrames, rectify, smoothed
from service.depth.stereo.stereo_pair import Disparity, match
from stage.capture.camera import Camera, OtherCamera
from tests.scenes import stereo as scenes
from tests.scenes.depth import entry_of
from tests.scenes.projected import Ball, Shape, Wall, rectangle
from tests.scenes.stereo import CAMERA, OTHER, POSE

NOISE = NoiseModel(0.003, 1e-4)
RANGE_PX = 96
"""Disparities that both matchers consider."""
LARGE, LARGE_RANGE = (800, 1280), 128
"""Rows and columns of the pair whose matching is timed, and its disparities."""
SCENES = {
    "tilted plane": [Wall((0.02, 0.0, -1.1), (-0.35, 0.2, 1.0), 0.7)],
    "sphere before a plane": [Wall((0.0, 0.05, -1.05), (0.25, -0.3, 1.0), 0.65), Ball((-0.06, 0.05, -0.88), 0.1, 0.55)],
    "parts before each other": [Wall((0, 0, -1.3), (0.1, 0.05, 1), 0.6), rectangle((-0.16, 0.02), (-0.12, 0.1), 0.9),
                                rectangle((0.1, 0.2), (-0.3, 0.05), 1.1), rectangle((-0.25, -0.2), (-0.1, 0.1), 1.0, 0.01)],
    "bars of 2, 7 and 19 pixels": [Wall((0, 0, -1.15), (0.05, 0.1, 1), 0.6), *(rectangle(x, (-0.3, 0.3), depth) for x, depth in (
        ((-0.1, -0.095), 0.9), ((0.03, 0.045), 0.85), ((0.1, 0.14), 0.9)))],
}


class Share(NamedTuple):
    """What became of the pixels of one scene."""

    visible: float
    """Part of the pixels whose place both cameras see that are right within a pixel."""
    refused: float
    """Part of all pixels that have no depth."""
    wrong: float
    """Part of the pixels with a depth that are off by a pixel or more."""
    rms_px: float
    """Root mean square error of the pixels that are right."""
    within: tuple[float, float]
    """Parts of the right pixels whose error is within σ and 2σ; NaN without a σ."""


def pair_of(parts: Sequence[Shape], textures: int) -> tuple[RectifiedFrames, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return rectified frames, and for every pixel of the camera its row and column there, its true disparity, and whether both see it."""
    patterns = [scenes.dots(300 + index) for index in range(textures)]
    left, right = scenes.render(parts, patterns), scenes.render(parts, patterns, OTHER, POSE)
    geometry = rectify(Camera(projection="perspective", **entry_of(CAMERA)),
                       OtherCamera(name="right", **entry_of(OTHER), camera_from_other=POSE.tolist()), where="")
    rng = np.random.default_rng(1)
    images = [[geometry.rows_of(smoothed((scenes.recorded(image, rng) / 65535).astype(np.float32)), other=side) for image in view.images]
              for view, side in ((left, False), (right, True))]
    frames = RectifiedFrames(*(np.stack([image for image, _ in each]) for each in images), *(each[0][1] for each in images))
    x, y, ahead = geometry.positions(slice(0, CAMERA.height))
    truth = geometry.focal_px * geometry.baseline_m / (left.depth * ahead) - geometry.offset_px
    return frames, np.stack([y, x]), truth, scenes.visible_to(parts, left.points, POSE), left.depth


def shares(off: np.ndarray, known: np.ndarray, visible: np.ndarray, sigma: np.ndarray | None) -> Share:
    """Return what became of the pixels, from the error of each and whether it has a depth."""
    right = known & (np.abs(off) < 1)
    within = (np.nan, np.nan) if sigma is None else tuple(float((np.abs(off[right]) < times * sigma[right]).mean()) for times in (1, 2))
    return Share(float((right & visible).sum() / visible.sum()), float((~known).mean()), float((known & ~right).sum() / known.sum()),
                 float(np.sqrt(np.mean(off[right] ** 2))), (within[0], within[1]))


def sampled(found: Disparity, at: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return disparity, σ and whether it counts, at places of the rectified image."""
    row, col = (np.clip(np.rint(each), 0, size - 1).astype(int) for each, size in zip(at, found.status.shape, strict=True))
    disparity = found.disparity[row, col] + found.slope_y[row, col] * (at[0] - row) + found.slope_x[row, col] * (at[1] - col)
    return disparity, found.sigma[row, col], found.status[row, col] == Status.OK


def opencv(left: np.ndarray, right: np.ndarray, least: int, count: int) -> np.ndarray:
    """Return the disparity of OpenCV's matcher, NaN where it has none."""
    width, white = max(left.shape[1], right.shape[1]) + count, float(np.percentile(left, 99.5))
    given = []
    for image in (left, right):  # with columns on both sides, because it leaves out columns whose range leads out of the image
        wide = np.pad(image, ((0, 0), (count, width - image.shape[1])), mode="edge")
        given.append(np.rint(255 * np.clip(wide / white, 0, 1)).astype(np.uint8))
    matcher = cv2.StereoSGBM_create(minDisparity=least, numDisparities=count, blockSize=5, P1=200, P2=800, disp12MaxDiff=1,
                                    uniquenessRatio=10)
    found = matcher.compute(*given).astype(np.float32)[:, count:count + left.shape[1]] / 16
    return np.where(found < least, np.nan, found)


def matched(frames: RectifiedFrames, least: int, count: int, device: str) -> Disparity:
    """Return the disparity of all bands."""
    return [found for _, found in match(frames, least, least + count - 1, NOISE, device)][-1]


def main() -> None:
    """Print both tables."""
    device = devices.resolve(sys.argv[1] if len(sys.argv) > 1 else None)
    print("| scene | frames | right of visible | refused | wrong of given | RMS, px | within σ, 2σ | OpenCV: right | wrong | RMS, px |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name, parts in SCENES.items():
        for textures in (1, 4):
            frames, at, truth, visible, _ = pair_of(parts, textures)
            disparity, sigma, known = sampled(matched(frames, -32, RANGE_PX, device), at)
            ours = shares(disparity - truth, known, visible, sigma)
            row, col = (np.clip(np.rint(each), 0, size - 1).astype(int) for each, size in zip(at, frames.left.shape[1:], strict=True))
            its = opencv(frames.left[0], frames.right[0], -32, RANGE_PX)[row, col]
            theirs = shares(np.nan_to_num(its - truth, nan=9.0), np.isfinite(its), visible, None)
            print(f"| {name} | {textures} | {100 * ours.visible:.1f} % | {100 * ours.refused:.1f} % | {100 * ours.wrong:.3f} % | "
                  f"{ours.rms_px:.3f} | {100 * ours.within[0]:.0f} %, {100 * ours.within[1]:.0f} % | "
                  + (f"{100 * theirs.visible:.1f} % | {100 * theirs.wrong:.2f} % | {theirs.rms_px:.3f} |" if textures == 1 else "| | |"))
    rows, cols = LARGE
    texture = smoothed(np.random.default_rng(0).random((rows, cols + LARGE_RANGE), np.float32))
    ramp = np.linspace(10, LARGE_RANGE - 10, cols)
    right = np.stack([np.interp(np.arange(cols), np.arange(cols) - ramp, line[:cols]) for line in texture]).astype(np.float32)
    left = np.ascontiguousarray(texture[:, :cols])
    frames = RectifiedFrames(left[None], right[None], np.ones(LARGE, bool), np.ones(LARGE, bool))
    bytes_of = [np.rint(255 * np.clip(image / left.max(), 0, 1)).astype(np.uint8) for image in (left, right)]
    matcher = cv2.StereoSGBM_create(minDisparity=0, numDisparities=LARGE_RANGE, blockSize=5, P1=200, P2=800, disp12MaxDiff=1)
    seconds = [min(run_seconds(work, 3)) / (rows * cols / 1e6) for work in (
        lambda: matched(frames, 0, LARGE_RANGE, device), lambda: matcher.compute(*bytes_of))]
    print(f"\nseconds a megapixel, {LARGE_RANGE} disparities, one frame, {devices.describe(device)}: {seconds[0]:.2f}, OpenCV's StereoSGBM "
          f"(five directions) {seconds[1]:.2f} on the CPU: {seconds[0] / seconds[1]:.1f} times as long")


if __name__ == "__main__":
    main()
