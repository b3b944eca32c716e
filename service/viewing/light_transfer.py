"""Convert light of any direction to weights of the captured images by a table over a lat-long grid of directions.

Each pixel of the grid is shared out over the captured lights with the weights of `relit relight` without maps. These weights are
least-error ones that may not be negative, so those of a whole environment are close to the sum of those of its parts, and not equal.

The error of a basis is measured in pictures under lights that it was not made from: key lights from between the captured lights, and
light from all around. The truth is the weighted sum of the captured images, which is what `relit relight` without maps renders.
"""

from typing import Any, NamedTuple

import numpy as np

from kernels.relight.model.beyond import share_beyond
from service.relight.weights.weighting import light_weights, share_samples
from service.requests.relight import LightWeights
from stage.capture.point_lights import DistantLights
from stage.colour.colour import convert
from stage.results.light_basis import numbers
from stage.stack.stack import Stack

COLS, ROWS = 64, 32
"""Directions around and from +y to −y: 5.6 degrees apart, a third of the distance between the lights of a stage of a hundred."""
PARTS = 3
"""Samples down and across a pixel of the grid."""
FULL = 255
"""Stands for 1 in bytes."""
KEY_LIGHTS = 32
"""Number of key lights, spread evenly over the captured lights."""
CANDIDATES = 512
"""Number of directions, spread evenly over the sphere, that key lights are chosen from; none is of the grid that the basis is made for."""
GOLDEN = np.pi * (3 - np.sqrt(5))
WHITE = 0.99
"""The quantile of the brightest channel that is white, as the page exposes for a light."""
SAMPLED = 2000
"""Number of pixels that the exposures are taken from."""
STEPS = 1 << 16
"""Number of linear values whose display values are kept: steps of 0.05 levels where the curve is steepest."""


class Transfer(NamedTuple):
    """The weights of the captured images for a unit of irradiance from each direction of the grid, row by row."""

    weights: np.ndarray  # [ROWS · COLS, 3, lights] float32
    solid_angle: np.ndarray  # [ROWS · COLS] of the pixels, in any unit
    beyond: np.ndarray  # [ROWS, COLS] uint8: 0 between the captured lights, 255 wholly beyond them


def transfer_of(lights: DistantLights) -> Transfer:
    """Return the table of captured lights."""
    solid_angle = np.linalg.norm(grid_directions(PARTS, unit=False), axis=-1)
    energy = solid_angle / solid_angle.sum(axis=1, keepdims=True)
    share = share_beyond(lights.direction, grid_directions(1)[:, 0])
    return Transfer(weights_of(grid_directions(PARTS), energy, lights), solid_angle.sum(axis=1),
                    np.floor(FULL * share).astype(np.uint8).reshape(ROWS, COLS))


def weights_of(samples: np.ndarray, energy: np.ndarray, lights: DistantLights) -> np.ndarray:
    """Return the weights [kinds, 3, lights] float32 of the captured images for white light of several kinds.
    `samples`: [kinds, n, 3] unit vectors to each. `energy`: [kinds, n] irradiance of each sample."""
    found = np.zeros((len(samples), 3, len(lights.direction)), dtype=np.float32)
    for begin in range(0, len(samples), COLS):
        part = slice(begin, begin + COLS)
        channels = np.stack([np.diag(each) for each in energy[part].T], axis=1)  # [kinds, n, kinds]: a channel of its own for each
        shared = share_samples(samples[part].reshape(-1, 3), channels.reshape(-1, channels.shape[2]), lights.direction,
                               weighting=LightWeights.KERNEL)
        found[part] = light_weights(shared.T[..., None].repeat(3, axis=2), lights.irradiance, np.ones(len(lights.direction)))
    return found


def grid_directions(parts: int, *, unit: bool = True) -> np.ndarray:
    """Return the directions of the grid, row by row, [ROWS · COLS, parts², 3] float64.
    `parts`: samples down and across a pixel; 1: its middle. `unit`: make them unit vectors; else their length is sin πv, in proportion to
    the solid angle of a sample.

    Convention:
        +y at the top, +z in the middle of the grid, +x a quarter from the left edge.
    """
    v, u = ((np.arange(count * parts) + 0.5) / (count * parts) for count in (ROWS, COLS))
    polar, azimuth = np.pi * v[:, None], 2 * np.pi * u
    directions = np.stack(np.broadcast_arrays(np.sin(azimuth) * np.sin(polar), np.cos(polar), -np.cos(azimuth) * np.sin(polar)), axis=-1)
    if not unit:
        directions = directions * np.sin(polar)[..., None]
    return directions.reshape(ROWS, parts, COLS, parts, 3).swapaxes(1, 2).reshape(ROWS * COLS, parts**2, 3)


class HeldOutLights:
    """Sums up how far pictures of a basis are from those of the captured images, under each light."""

    def __init__(self, stack: Stack, lights: DistantLights, transfer: Transfer, covered: np.ndarray) -> None:
        """Choose the lights, and an exposure for each.
        `transfer`: the table of directions of the lights. `covered`: [pixels padded] bool, pixels of the object."""
        sky = np.einsum("dcl,d->cl", transfer.weights, transfer.solid_angle / transfer.solid_angle.sum())
        keys = key_weights(lights)
        self.weights = np.concatenate([keys, sky[None]]).astype(np.float32)  # [pictures, 3, lights]
        pixels = np.flatnonzero(covered)
        radiance, _ = stack.pick_radiance(pixels[:: max(1, len(pixels) // SAMPLED)])
        brightest = np.einsum("ncl,lpc->npc", self.weights, radiance, optimize=True).max(axis=2)
        white = np.quantile(brightest, WHITE, axis=1)
        self._gains = np.where(white > 0, 1 / np.where(white > 0, white, 1), 1.0)
        steps = np.linspace(0, 1, STEPS, dtype=np.float32)
        self._display = convert(steps[None, :, None], "lin_rec709_scene", "srgb_texture")[0, :, 0]
        self._levels, self._values = np.zeros(len(self.weights)), 0
        self._squares, self._whole = np.zeros(len(self.weights)), np.zeros(len(self.weights))

    def compare(self, images: np.ndarray, shown: np.ndarray, inside: np.ndarray) -> None:
        """Count some pixels of the captured images [tiles, 3, lights, pixels], shown as the basis gives them; `inside` says which."""
        truth, found = (self._encoded(values, inside) for values in (images, shown))
        for picture, (true, other) in enumerate(zip(truth, found, strict=True)):
            self._squares[picture] += ((true[0] - other[0]) ** 2).sum(dtype=np.float64)
            self._whole[picture] += (true[0] ** 2).sum(dtype=np.float64)
            self._levels[picture] += np.abs(true[1] - other[1]).sum(dtype=np.float64)
        self._values += 3 * int(inside.sum())

    def facts(self) -> dict[str, Any]:
        """Return what view.json says of the differences."""
        levels = FULL * self._levels / max(1, self._values)
        relative = np.sqrt(self._squares / np.where(self._whole > 0, self._whole, 1))
        keys = levels[:-1]
        return {"key_lights": KEY_LIGHTS, "mean_levels": numbers(float(keys.mean())), "largest_levels": numbers(float(keys.max())),
                "relative_rms": numbers(float(np.sqrt((relative[:-1] ** 2).mean()))), "even_sky_levels": numbers(float(levels[-1]))}

    def _encoded(self, images: np.ndarray, inside: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return radiance and display values [pixels inside, 3] of each picture."""
        pictures = np.moveaxis(np.stack([np.matmul(self.weights[:, c], images[:, c]) for c in range(3)], axis=-1), 1, 0)[:, inside]
        return [(picture, self._display[np.rint((STEPS - 1) * np.clip(picture * gain, 0, 1)).astype(np.int64)])
                for picture, gain in zip(pictures, self._gains, strict=True)]


def key_weights(lights: DistantLights) -> np.ndarray:
    """Return the weights [KEY_LIGHTS, 3, lights] of the captured images under each key light of irradiance 1."""
    return weights_of(key_directions(lights.direction)[:, None], np.ones((KEY_LIGHTS, 1)), lights)


def key_directions(captured: np.ndarray) -> np.ndarray:
    """Return [KEY_LIGHTS, 3] directions spread over those that are least beyond the captured lights [lights, 3]."""
    place = np.arange(CANDIDATES) + 0.5
    height = 1 - 2 * place / CANDIDATES
    across = np.sqrt(1 - height**2)
    spread = np.stack([across * np.cos(GOLDEN * place), height, across * np.sin(GOLDEN * place)], axis=1)
    beyond = share_beyond(captured, spread)
    among = np.flatnonzero(beyond <= np.partition(beyond, KEY_LIGHTS - 1)[KEY_LIGHTS - 1])
    return spread[among[np.linspace(0, len(among) - 1, KEY_LIGHTS).round().astype(int)]]
