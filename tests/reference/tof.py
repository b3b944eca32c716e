"""Raw time-of-flight data with a known truth, and slow float64 twins of the decoders; nothing here is shared with what it judges."""

from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

LIGHT = 299_792_458.0
HZ = (20e6, 30e6, 80e6)


class View(NamedTuple):
    distance: np.ndarray  # [rows, cols] metres along the ray
    albedo: np.ndarray  # [rows, cols]
    cosine: np.ndarray  # [rows, cols]


def room(rows: int = 96, cols: int = 128) -> View:
    """A slanted wall from 0.5 to 11.6 m, a sphere and a post in front of it, tiles of four albedos."""
    v, u = np.mgrid[0:rows, 0:cols] / np.array([rows, cols]).reshape(2, 1, 1)
    distance = 0.5 + 11.1 * np.clip(0.75 * u + 0.25 * v, 0, 1)
    cosine = np.full((rows, cols), 0.8)
    x, y = (u - 0.55) / 0.2, (v - 0.45) / 0.27
    inside = x**2 + y**2 < 1
    bulge = np.sqrt(np.clip(1 - x**2 - y**2, 0, None))
    distance = np.where(inside, 3.0 - bulge, distance)
    cosine = np.where(inside, np.clip(bulge, 0.15, 1), cosine)
    post = (u > 0.8) & (u < 0.86) & (v > 0.2)
    distance, cosine = np.where(post, 2.2, distance), np.where(post, 0.95, cosine)
    tiles = np.array([0.35, 0.8, 0.5, 0.65])[((8 * u).astype(int) + 2 * (6 * v).astype(int)) % 4]
    return View(distance, tiles, cosine)


def signal(view: View, at_one_metre: float) -> np.ndarray:
    return at_one_metre * view.albedo * view.cosine / view.distance**2


def correlations(view: View, at_one_metre: float, settings: list[tuple[float, float]], *, ambient: float = 0.0, read: float = 5.0,
                 seed: int | None = None, harmonics: dict[int, float] | None = None, second: tuple[float, float] | None = None
                 ) -> np.ndarray:
    """[image, rows, cols]: I = ambient + A + A·w(φ - δ); `second` is (metres behind, part of the signal)."""
    made = []
    rng = None if seed is None else np.random.default_rng(seed)
    for hz, delta in settings:
        image = np.full(view.distance.shape, ambient)
        for behind, part in ((0.0, 1.0), *([second] if second else [])):
            turn = 2 * np.pi * ((2 * (view.distance + behind) / LIGHT) * hz % 1.0) - delta
            wave = np.cos(turn)
            for order, weight in (harmonics or {}).items():
                wave = wave + weight * np.cos(order * turn)
            image = image + part * signal(view, at_one_metre) * (1 + wave)
        made.append(image if rng is None else rng.poisson(np.maximum(image, 0)) + read * rng.standard_normal(image.shape))
    return np.array(made)


def even(hz: tuple[float, ...], phases: int) -> list[tuple[float, float]]:
    return [(f, 2 * np.pi * k / phases) for f in hz for k in range(phases)]


def histogram(view: View, at_one_metre: float, *, bins: int = 64, bin_s: float = 1.5e-9, start_s: float = 0.0, sigma_s: float = 1.2e-9,
              background: float = 0.5, seed: int | None = None, pulses: int | None = None,
              second: tuple[float, float] | None = None) -> np.ndarray:
    """[rows, cols, bins] photons; with `pulses` only the first of each pulse is counted, drawn pulse by pulse as a multinomial."""
    edges = start_s + bin_s * np.arange(bins + 1)
    mean = np.full((*view.distance.shape, bins), background)
    for behind, part in ((0.0, 1.0), *([second] if second else [])):
        arrival = 2 * (view.distance + behind)[..., None] / LIGHT
        mean = mean + part * signal(view, at_one_metre)[..., None] * np.diff(ndtr((edges - arrival) / sigma_s), axis=-1)
    if pulses is None:
        return mean if seed is None else np.random.default_rng(seed).poisson(mean).astype(float)
    none_before = np.exp(-(np.cumsum(mean, axis=-1) - mean) / pulses)
    first = none_before * (1 - np.exp(-mean / pulses))
    if seed is None:
        return pulses * first
    whole = np.concatenate([first, 1 - first.sum(axis=-1, keepdims=True)], axis=-1)
    return np.random.default_rng(seed).multinomial(pulses, whole)[..., :-1].astype(float)


def phases(images: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """[3, pixel]: P, Q, φ of one frequency by float64 least squares."""
    matrix = np.stack([np.ones_like(delta), np.cos(delta), np.sin(delta)], axis=1)
    level, a, b = np.linalg.lstsq(matrix, images.reshape(len(delta), -1).astype(float), rcond=None)[0]
    return np.stack([level, np.hypot(a, b), np.arctan2(b, a) % (2 * np.pi)])


def most_likely_range(phase: np.ndarray, sigma: np.ndarray, hz: tuple[float, ...], farthest: float, step: float = 2e-3) -> np.ndarray:
    """[pixel] range of least squared phase error, by trying every `step` metres: the slow twin of unwrapping."""
    tried = np.arange(0, farthest, step)
    cost = np.zeros((phase.shape[1], len(tried)))
    for f, frequency in enumerate(hz):
        away = np.angle(np.exp(1j * (phase[f][:, None] - 4 * np.pi * frequency / LIGHT * tried)))
        cost += (away / sigma[f][:, None]) ** 2
    return tried[np.argmin(cost, axis=1)]


def first_photon_flux(counts: np.ndarray, pulses: int) -> np.ndarray:
    """[bins] expected photons from first-photon counts, bin after bin."""
    left, flux = float(pulses), []
    for n in counts:
        flux.append(-pulses * np.log(1 - n / left))
        left -= n
    return np.array(flux)


def joint_bilateral(distance: np.ndarray, sigma: np.ndarray, guide: np.ndarray, *, radius: int, spatial: float, relative: float,
                    sigmas: float, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Range and deviation: weighted least-squares plane in each window, pixel after pixel; all pixels are valid."""
    rows, cols = distance.shape
    out, spread = np.empty_like(distance), np.empty_like(distance)
    for r in range(rows):
        for c in range(cols):
            i, j = np.mgrid[max(r - radius, 0):min(r + radius + 1, rows), max(c - radius, 0):min(c + radius + 1, cols)]
            d, v, g = distance[i, j], sigma[i, j] ** 2, guide[i, j]
            unlike = ((g - guide[r, c]) / (relative * np.maximum(g, guide[r, c]))) ** 2
            unlike = unlike + (d - distance[r, c]) ** 2 / (sigmas**2 * (v + sigma[r, c] ** 2) + (step * distance[r, c]) ** 2)
            w = np.exp(-0.5 * (((i - r) ** 2 + (j - c) ** 2) / spatial**2 + unlike)) / v
            plane = np.stack([np.ones(w.size), (j - c).ravel(), (i - r).ravel()], axis=1)
            rule = np.linalg.solve(plane.T @ (w.ravel()[:, None] * plane), plane.T * w.ravel())[0]
            out[r, c], spread[r, c] = rule @ d.ravel(), np.sqrt((rule**2) @ v.ravel())
    return out, spread


def time_posterior(counts: np.ndarray, background: float, sigma_bins: float, peak: float, reach: float, *, pulses: int | None = None
                   ) -> tuple[float, float]:
    """Mean and standard deviation of a return's time with a flat prior within `reach` bins of the peak, by trying times and strengths."""
    edges, times = np.arange(len(counts) + 1), np.linspace(peak - reach, peak + reach, 2001)
    part = np.diff(ndtr((edges - times[:, None]) / sigma_bins), axis=1)
    strengths = np.maximum(counts.sum() - background * len(counts), 1.0) * np.geomspace(0.3, 10.0, 150)
    best = np.full(len(times), -np.inf)
    for strength in strengths:
        mean = background + strength * part
        if pulses is None:
            likelihood = counts @ np.log(mean).T - mean.sum(axis=1)
        else:
            left = pulses - np.concatenate([[0.0], np.cumsum(counts)[:-1]])
            likelihood = counts @ np.log(-np.expm1(-mean / pulses)).T - mean @ (left - counts) / pulses
        best = np.maximum(best, likelihood)
    weight = np.exp(best - best.max())
    middle = np.average(times, weights=weight)
    return float(middle), float(np.sqrt(np.average((times - middle) ** 2, weights=weight)))
