"""Between which offsets of a part its surface hides a light from a pixel: one march along the ray serves all offsets.

A part moves along the lines of sight. The ray from a pixel to a distant light keeps its path in the image while a part moves, whether the
pixel lies on that part or on another. So along the path only the gap between the ray and the surface changes, everywhere by
the same amount: the offset in z of an orthographic camera, and in -log depth of a perspective one, where a part moves by growing about the
eye. The largest and the smallest gap therefore tell at which offsets the surface stands before the ray, and at which the whole
surface on the way lies in front of it.

A ray that passes through the visible front of a part is hidden. One that lies behind that front all along its way may pass behind the part.
Nothing tells how thick a part is; the guess is that its back is its front mirrored in its outline.
"""

from typing import NamedTuple

import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.surface.shadows import FIRST_STEP, MARGIN_PIXELS, MARGIN_SLOPE, Projection, project, unproject

wp.set_module_options({"enable_backward": False})

NO_GAP = -1.0e30
"""Stands for the largest gap where the path never crosses the surface that moves against the pixel."""


class PartShadows(NamedTuple):
    """What the surface on the way to the light does, for each pixel and light."""

    highest: wp.array  # [pixels, lights] float32: largest height of the surface above the ray, over all of it that moves against the pixel
    lowest: wp.array  # [pixels, lights] float32: the least
    back: wp.array  # [pixels, lights] float32: least height of the guessed back above the ray
    hidden: wp.array  # [pixels, lights] uint8: whether surface that moves with the pixel hides the light, whatever the offset


@wp.kernel
def _march(first: int,
           pixels: wp.array(dtype=wp.vec2i),
           toward: wp.array(dtype=wp.vec3),
           height: wp.array2d(dtype=float),
           part: wp.array2d(dtype=wp.int32),
           thickness: wp.array2d(dtype=float),
           moving: int,
           perspective: bool,
           scale: wp.vec2,
           centre: wp.vec2,
           # outputs
           highest: wp.array2d(dtype=float),
           lowest: wp.array2d(dtype=float),
           back: wp.array2d(dtype=float),
           hidden: wp.array2d(dtype=wp.uint8)):
    n = first + wp.tid()
    row, col = pixels[n][0], pixels[n][1]
    rows, cols = part.shape[0], part.shape[1]
    moves = part[row, col] == moving
    start = unproject(float(col) + 0.5, float(row) + 0.5, height[row, col], perspective, scale, centre)
    pixel = wp.where(perspective, -start[2], 1.0) / (0.5 * (scale[0] + scale[1]))
    for light in range(toward.shape[0]):
        way = toward[light]
        across = wp.sqrt(way[0] * way[0] + way[1] * way[1])
        stride = pixel / wp.max(across, 1.0e-4)
        travelled = FIRST_STEP * stride
        top, bottom, rear = float(NO_GAP), float(-NO_GAP), float(-NO_GAP)  # literals could not change inside the loop
        own = wp.uint8(0)
        for _ in range(rows + cols):
            point = start + travelled * way
            at = project(point, perspective, scale, centre)
            c, r = int(wp.floor(at[0])), int(wp.floor(at[1]))
            if c < 0 or r < 0 or c >= cols or r >= rows or (perspective and point[2] >= 0.0):
                break
            if part[r, c] >= 0:
                if (part[r, c] == moving) == moves:
                    if height[r, c] - point[2] > MARGIN_PIXELS * pixel + MARGIN_SLOPE * travelled * across:
                        own = wp.uint8(1)
                        break
                else:
                    gap = wp.where(perspective, wp.log(point[2] / height[r, c]), height[r, c] - point[2])
                    top, bottom = wp.max(top, gap), wp.min(bottom, gap)
                    rear = wp.min(rear, gap - thickness[r, c])
            travelled += stride
        highest[n, light] = top
        lowest[n, light] = bottom
        back[n, light] = rear
        hidden[n, light] = own


def march_part(pixels: wp.array, toward: wp.array, height: wp.array, part: wp.array, thickness: wp.array, moving: int,
               projection: Projection) -> PartShadows:
    """March from pixels to distant lights over a surface of which one part moves.

    Args:
        pixels: [n] vec2i, row and column of pixels of some part.
        toward: [lights] vec3, unit directions to the lights.
        height: [rows, cols] float32, camera-frame z.
        part: [rows, cols] int32, the part of each pixel, below 0 outside.
        thickness: [rows, cols] float32, guessed distance from front to back, in the unit of the gaps.
        moving: number of the part that moves against all others.
        projection: of the camera; its unit is that of height.

    Returns:
        On the device of height; gaps in the unit of height, or for a perspective camera in log depth. Not synchronised on CUDA.

    Raises:
        ArrayError: height, part and thickness are of different shapes.
    """
    if not height.shape == part.shape == thickness.shape:
        raise ArrayError(f"height is {height.shape}, part {part.shape}, thickness {thickness.shape}: give one of each for every pixel")
    shape, device = (pixels.shape[0], toward.shape[0]), height.device.alias
    found = PartShadows(*(wp.empty(shape, dtype=float, device=device) for _ in range(3)), wp.empty(shape, dtype=wp.uint8, device=device))
    inputs = [pixels, toward, height, part, thickness, moving, *projection]
    devices.launch(_march, shape[0], inputs, list(found), device=device, uneven=True)
    return found
