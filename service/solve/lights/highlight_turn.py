"""By which turn of all lights, against the axis of the camera, highlights and shading show the same surface.

A highlight shows where the normal halves the angle between light and viewer, and the shading around it where it leans to the light. Where
all lights are turned, shading turns the normals with them and highlights by half of that: no normal explains both. At some hundred pixels
normal, albedo, F0 and roughness are fitted together with one turn of all lights. A turn about the viewing axis turns normals and
highlights alike, and is told by slopes alone (service.solve.lights.slope_turn).

Source: Georghiades, "Incorporating the Torrance and Sparrow model of reflectance in uncalibrated photometric stereo", ICCV 2003, for
highlights as what settles which lights and normals explain shading; Cameron, Gelbach and Miller, "Robust inference with multiway
clustering", Journal of Business & Economic Statistics 29(2), 2011, for errors that pixels share, and lights.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from kernels.photometric.model.samples import some_of
from service.light_estimation.explanations import grey_readings
from service.solve.base.batches import view_directions
from service.solve.base.solution import SolveInput
from stage.capture.camera import Camera
from stage.capture.point_lights import DistantLights, PlacedLights
from stage.spread import between_blocks

PIXELS, LEAST_PIXELS, LEAST_LIGHTS = 600, 100, 8
"""Pixels that are fitted, and the number of these and of lights below which nothing is concluded: a pixel has five unknowns."""
LIT = 0.2
"""Least n·l of a reading from which the albedo is first taken."""
START_F0, START_ROUGHNESS = 0.04, 0.4
NOISE, DARK, OUTLIER = 0.01, 0.3, 3.0
"""Standard deviation of a reading in the bright ones of its pixel, the part of it that is left in the dark (as a square), and standard
deviations from which a reading counts less."""
LOWEST, HIGHEST = np.log([[1e-4], [1e-4], [1e-3]]), np.log([[1e3], [1.0], [1.0]])
"""Bounds of the logarithms of albedo, F0 and α: in captures without a scale albedo may be any number."""
HELD = np.array([0.0, 0.0, 1.0, 4.0, 4.0])
"""Weight of the parameters of a pixel as they are: readings that show no highlight leave its F0 and roughness open."""
ROUNDS, ALONE, LARGEST_STEP = 20, 2, 0.3
"""Steps of the fit, those before the turn is fitted too, and the largest change of a parameter in one of them."""
STEP = 1e-4
"""Change of a parameter by which derivatives are taken."""
SHOWN, LEAST_SHOWN = 0.1, 0.2
"""Part of the brightest reading of a pixel that its highlight is, from which it has one, and the least part of the pixels that have one."""
LEAST_SQUARE = 150.0
"""Least square of a turn over its covariance: right captures have up to 100, turns of 5° have 70 to 10 000 on real objects."""
LEAST_LESS = 9.0
"""Least sum over the pixels by which their costs drop, in the root of the sum of the squares of these drops: right captures have up to 8.8;
turns of 5° have 12."""


class _Sample(NamedTuple):
    readings: np.ndarray  # [lights, pixels] radiance over irradiance
    usable: np.ndarray  # [lights, pixels] bool
    sigma: np.ndarray  # [lights, pixels]
    lamps: "_Lamps"

    def weights(self, left: np.ndarray) -> np.ndarray:
        """Return the weights of readings that are off by `left`, [lights, pixels]."""
        return self.usable / (1 + (left / (OUTLIER * self.sigma))**2) / self.sigma**2

    def cost(self, left: np.ndarray) -> np.ndarray:
        """Return the cost of each pixel, [pixels]."""
        return (self.usable * np.log1p((left / (OUTLIER * self.sigma))**2)).sum(axis=0)


class _Seen(NamedTuple):
    """Lights as pixels see them; where all see the same, one stands for them."""

    direction: np.ndarray  # [lights, pixels or 1, 3] unit
    half: np.ndarray  # [lights, pixels or 1, 3] unit, between light and viewer
    rise: np.ndarray  # [lights, pixels or 1] Schlick's rise of Fresnel's reflectance
    shining: np.ndarray  # [lights, pixels or 1] irradiance for strength 1


class _Lamps(NamedTuple):
    """Lights around the centre of the object."""

    way: np.ndarray  # [lights, 3] from the centre, metres; directions of distant lights
    near: np.ndarray  # [lights, 1] 1.0 for near lights, else 0.0
    lobe: np.ndarray  # [lights, 4] unit axis and exponent, as `PlacedLights` has it
    points: np.ndarray  # [pixels, 3] from the centre, metres; [1, 3] where lights are distant
    view: np.ndarray  # [pixels, 3] unit, to the viewer; [1, 3] where all are looked at alike

    def seen(self, turn: Rotation) -> _Seen:
        """Return the turned lights."""
        points = np.stack([*self.points.T[:2], turn.apply(self.points)[:, 2]], axis=1)  # the surface was integrated from turned normals
        way = turn.apply(self.way)[:, None] - self.near[..., None] * points
        distance = np.maximum(np.linalg.norm(way, axis=2), 1e-12)
        direction = way / distance[..., None]
        shining = np.where(self.near == 1, 1 / distance**2, 1.0)
        if self.lobe.any():
            shining *= np.maximum(-np.einsum("lpc,lc->lp", direction, turn.apply(self.lobe[:, :3])), 0) ** self.lobe[:, 3:]
        half = direction + self.view
        half /= np.linalg.norm(half, axis=2, keepdims=True)
        return _Seen(direction, half, (1 - np.einsum("lpc,pc->lp", half, self.view))**5, shining)


class _Fit(NamedTuple):
    """Pixels and the turn that are fitted."""

    normal: np.ndarray  # [pixels, 3]
    logs: np.ndarray  # [3, pixels] logarithms of albedo, F0 and α
    turn: Rotation

    def left(self, sample: _Sample, seen: _Seen | None = None) -> np.ndarray:
        """Return readings less model, [lights, pixels]. `seen`: the lights; None: they are turned anew."""
        seen = sample.lamps.seen(self.turn) if seen is None else seen
        return sample.readings - _reflect(self.normal, sample.lamps.view, seen, np.exp(self.logs)) * seen.shining

    def shown(self, sample: _Sample) -> float:
        """Return the part of the pixels that have a highlight."""
        seen = sample.lamps.seen(self.turn)
        matt = np.exp(self.logs[0]) / np.pi * np.maximum(np.einsum("lpc,pc->lp", seen.direction, self.normal), 0) * seen.shining
        whole = sample.readings - self.left(sample)
        return float(np.mean((whole - matt).max(axis=0) > SHOWN * whole.max(axis=0)))

    def moved(self, sides: np.ndarray, steps: np.ndarray, turn: np.ndarray) -> "_Fit":
        """Return another fit. `sides`: [2, pixels, 3] tangents of the normals. `steps`: [pixels, 5] along them and of the logarithms.
        `turn`: [2] about x and y."""
        normal = self.normal + (steps.T[:2, :, None] * sides).sum(axis=0)
        return _Fit(normal / np.linalg.norm(normal, axis=1, keepdims=True), np.clip(self.logs + steps.T[2:], LOWEST, HIGHEST),
                    Rotation.from_rotvec([*turn, 0]) * self.turn)


class Shown(NamedTuple):
    """What highlights show of a turn of all lights."""

    right: Rotation
    """The turn that brings lights to the right ones, none about z."""
    covariance: np.ndarray  # [3, 3] of its rotation vector, nothing about z
    sure: bool
    """Whether the highlights say that the lights are turned."""


def turn_by_highlights(given: SolveInput, lights: DistantLights | PlacedLights, normal: np.ndarray, solved: np.ndarray,
                       height: np.ndarray | None) -> Shown | None:
    """Return what highlights show; None where there are none.
    `normal`: [3, pixels of the image] unit, as solved with these lights. `solved`: [pixels of the image] bool, where there is one.
    `height`: [rows, cols] camera-frame z in metres, where lights are near."""
    pixels = some_of(solved, PIXELS)
    radiance, usable = given.stack.pick_radiance(pixels)
    usable &= (usable.sum(axis=0) >= LEAST_LIGHTS)[None]
    lamps, strength = _lamps(lights, given.camera, height, pixels)
    seen = lamps.seen(Rotation.identity())
    readings = grey_readings(radiance, strength)
    start = normal[:, pixels].T.astype(np.float64)
    cosine = np.einsum("lpc,pc->lp", seen.direction, start) * seen.shining
    lit = usable & (cosine > LIT * seen.shining) & (seen.shining > 0)
    level = np.percentile(readings, 90, axis=0)
    chosen = lit.any(axis=0) & (level > 0)
    if np.count_nonzero(chosen) < LEAST_PIXELS:
        return None
    pixels, readings, usable, start, cosine, lit = (
        pixels[chosen], readings[:, chosen], usable[:, chosen], start[chosen], cosine[:, chosen], lit[:, chosen])
    lamps, _ = _lamps(lights, given.camera, height, pixels)
    level = np.maximum(level[chosen], np.median(level[chosen]) / 2)
    sample = _Sample(readings, usable, NOISE * np.sqrt(level * (np.maximum(readings, 0) + DARK * level)), lamps)
    albedo = np.pi * np.nanmedian(np.where(lit, readings / np.where(lit, cosine, 1), np.nan), axis=0)
    constant = np.log([[START_F0], [START_ROUGHNESS**2]])
    first = _Fit(start, np.concatenate([np.log(np.maximum(albedo, 1e-3))[None], np.repeat(constant, len(pixels), axis=1)]),
                 Rotation.identity())
    place = np.divmod(pixels, given.mask.shape[1])
    fit, covariance = _fitted(sample, first, turning=True, place=place)
    vector = fit.turn.as_rotvec()[:2]
    if fit.shown(sample) < LEAST_SHOWN:
        return None
    sure = float(vector @ np.linalg.solve(covariance, vector)) > LEAST_SQUARE
    if sure:
        still, _ = _fitted(sample, first, turning=False, place=place)
        less = sample.cost(still.left(sample)) - sample.cost(fit.left(sample))
        sure = bool(less.sum() > LEAST_LESS * np.sqrt((less**2).sum()))
    return Shown(fit.turn, np.pad(covariance, (0, 1)), sure)


def _lamps(lights: DistantLights | PlacedLights, camera: Camera, height: np.ndarray | None,
           pixels: np.ndarray) -> tuple[_Lamps, np.ndarray]:
    """Return lights as some pixels see them, and their strength [lights, 3]. `height`: [rows, cols] metres, where lights are near."""
    view = view_directions(camera)(pixels if camera.projection == "perspective" else pixels[:1]).astype(np.float64)
    if isinstance(lights, DistantLights):
        none = np.zeros((len(lights.direction), 4))
        return _Lamps(lights.direction, none[:, :1], none, np.zeros((1, 3)), view), lights.irradiance
    assert height is not None  # near lights have found it with the normals
    near, points = lights.place[:, 3:], camera.points_at(pixels, height.reshape(-1)[pixels])
    return _Lamps(lights.place[:, :3] - near * lights.centre, near, lights.lobe, points - lights.centre, view), lights.strength


def _fitted(sample: _Sample, fit: _Fit, *, turning: bool, place: tuple[np.ndarray, np.ndarray]) -> tuple[_Fit, np.ndarray]:
    """Return the fit by Gauss's and Newton's method, whose steps pixels take that they bring nearer, and the covariance [2, 2] of the turn.
    `turning`: whether the turn is fitted too. `place`: rows and columns of the pixels."""
    damped = np.full(len(fit.normal), 1e-3)
    seen = sample.lamps.seen(fit.turn)
    left = fit.left(sample, seen)
    for number in range(ROUNDS):
        sides = _tangents(fit.normal)
        by, by_turn = _slopes(sample, fit, seen, left, sides)
        weight = sample.weights(left).T[..., None]
        weighed = (by * weight).transpose(0, 2, 1)
        own = weighed @ by
        own += np.einsum("p,pii,ij->pij", damped, own, np.eye(5)) + np.diag(HELD + 1e-9)
        solved = np.linalg.solve(own, np.concatenate([weighed @ by_turn, weighed @ left.T[..., None]], axis=2))
        alone = by_turn - by @ solved[..., :2]  # of the turn, where the pixel makes the best of it
        inverse = np.linalg.pinv((by_turn * weight).reshape(-1, 2).T @ alone.reshape(-1, 2))
        scores = alone * (weight * left.T[..., None])
        turn = inverse @ scores.sum(axis=(0, 1)) if turning and number >= ALONE else np.zeros(2)
        steps = np.clip(solved[..., 2] - solved[..., :2] @ turn, -LARGEST_STEP, LARGEST_STEP)
        still, moved = fit.moved(sides, np.zeros_like(steps), turn), fit.moved(sides, steps, turn)
        seen = sample.lamps.seen(still.turn)
        left_still, left_moved = still.left(sample, seen), moved.left(sample, seen)
        better = sample.cost(left_moved) < sample.cost(left_still)
        damped = np.clip(np.where(better, damped / 3, damped * 5), 1e-6, 1e6)
        fit = _Fit(np.where(better[:, None], moved.normal, still.normal), np.where(better, moved.logs, still.logs), moved.turn)
        left = np.where(better, left_moved, left_still)
    of_lights = scores.sum(axis=0)
    return fit, between_blocks(inverse, scores.sum(axis=1), *place) + inverse @ (of_lights.T @ of_lights) @ inverse


def _slopes(sample: _Sample, fit: _Fit, seen: _Seen, left: np.ndarray, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives of the model by the parameters of each pixel, [pixels, lights, 5], and by the turn, [pixels, lights, 2]."""
    steps = [STEP * np.broadcast_to(unit, (len(fit.normal), 5)) for unit in np.eye(5)]
    own = [fit.moved(sides, step, np.zeros(2)).left(sample, seen) for step in steps]
    turned = [fit.moved(sides, np.zeros_like(steps[0]), STEP * unit).left(sample) for unit in np.eye(2)]
    return np.stack([(left - other).T / STEP for other in own], axis=-1), np.stack([(left - other).T / STEP for other in turned], axis=-1)


def _reflect(normal: np.ndarray, view: np.ndarray, seen: _Seen, values: np.ndarray) -> np.ndarray:
    """Return the radiance under lights of irradiance 1, [lights, pixels]: Lambert's law and the lobe of kernels.microfacet.
    `normal`, `view`: [pixels, 3]. `values`: [3, pixels] albedo, F0 and α."""
    albedo, f0, alpha = values
    toward_light = np.maximum(np.einsum("lpc,pc->lp", seen.direction, normal), 0)
    toward_viewer = np.maximum((normal * view).sum(axis=-1), 0.05)
    toward_half, square = np.clip(np.einsum("lpc,pc->lp", seen.half, normal), 0, 1), alpha**2
    masking = toward_light * np.sqrt(toward_viewer**2 * (1 - square) + square)
    masking += toward_viewer * np.sqrt(toward_light**2 * (1 - square) + square)
    lobe = square * toward_light / (2 * np.pi * (1 - (1 - square) * toward_half**2)**2 * np.maximum(masking, 1e-6))
    return np.asarray(albedo / np.pi * toward_light + (f0 + (1 - f0) * seen.rise) * lobe)


def _tangents(normal: np.ndarray) -> np.ndarray:
    """Return two tangents of each normal, [2, pixels, 3]."""
    aside = np.where(np.abs(normal[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    one = np.cross(normal, aside)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return np.stack([one, np.cross(normal, one)])
