"""Kernels against NumPy twins, before any of them is timed: a fast kernel that is wrong is worth nothing.

Each check runs one kernel on a small scene whose last pack is not full, and returns what it found beside what the twin says.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import packs
from kernels.packs import Band
from kernels.photometric.gradient.moments import fit_moments
from kernels.photometric.lambertian.albedo import fit_albedo
from kernels.photometric.lambertian.lambert import solve_lambert
from kernels.photometric.lambertian.near import NearField, pad_places, see_near
from kernels.photometric.lambertian.readings import Lights, Readings, grey_factors, grey_readings, pad_lights
from kernels.photometric.lambertian.robust import solve_robust
from kernels.photometric.model.chosen_samples import choose
from kernels.photometric.model.samples import Samples, gather, readings_of
from kernels.photometric.search.hypotheses import LobeShape
from kernels.photometric.svbrdf import solve_svbrdf
from kernels.relight.basis.basis import gram, squared_residual
from kernels.relight.directions.latlong import cut
from kernels.relight.frames.combine import combine, combine_batch, combine_rows
from kernels.relight.weights.cells import nearest_light
from kernels.status import Status
from kernels.structured.binary import decode_gray
from kernels.structured.decoded import Decoded
from kernels.structured.pattern_frames import NoiseModel, upload
from kernels.structured.phase import decode_phase
from kernels.structured.ramp import decode_ramp
from kernels.structured.separation import separate
from kernels.structured.triangulate import ProjectorModel, triangulate
from kernels.structured.unwrap import unwrap_jointly
from kernels.surface.integrate import integrate_normals
from kernels.tof.continuous.continuous import ENTRIES, Noise, decode, sample_harmonics, straighten

GREY = (0.299, 0.587, 0.114)
LIGHTS, PIXELS, FRAMES = 21, 1003, 5
"""Counts that fill neither their padding nor their packs."""
WIDTH, PERIODS, STEPS = 1280.0, (16.0, 17.0, 19.0, 23.0), 4
"""Columns of a projector, and its phase patterns."""
NOISE = NoiseModel(0.003, 1e-4)
HALF, FLOAT = 2e-3, 2e-5
"""Errors, relative to the largest value, that images in half precision leave, and sums in float32."""

Compared = tuple[np.ndarray, np.ndarray, float]
"""What a kernel found, what its twin says, and by what part of the largest value they may differ."""


class Scene(NamedTuple):
    """A matt surface under distant lights, on the device."""

    lights: Lights
    images: np.ndarray  # [3, lights padded, pixels] float64, as half holds them
    normal: np.ndarray  # [pixels, 3]
    albedo: np.ndarray  # [3, pixels]
    band: Band

    @property
    def factors(self) -> np.ndarray:
        """[lights padded, 3] of each channel in a grey reading."""
        return grey_factors(self.lights, GREY)

    @property
    def grey(self) -> np.ndarray:
        """[lights padded, pixels] float64 grey readings."""
        return np.einsum("lc,clp->lp", self.factors, self.images)

    def readings(self) -> Readings:
        """Return the readings on the device, anew: solvers leave weights in them."""
        return grey_readings(self.band, self.factors)

    def samples(self) -> Samples:
        """Return all pixels as samples."""
        view = np.tile(np.array([0, 0, 1], dtype=np.float32), (PIXELS, 1))
        return gather(self.band, np.arange(PIXELS), view, self.lights, self.factors, LIGHTS)


def make_scene(device: str) -> Scene:
    """Return a scene in which every light reaches every pixel."""
    rng = np.random.default_rng(0)
    directions, normal = rng.normal(size=(LIGHTS, 3)) * [1, 1, 0] + [0, 0, 1.6], rng.normal(size=(PIXELS, 3)) * [0.2, 0.2, 0] + [0, 0, 1]
    for vectors in (directions, normal):
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    lights = pad_lights(directions, rng.uniform(0.5, 2, (LIGHTS, 3)))
    albedo = rng.uniform(0.2, 0.9, (3, PIXELS))
    cosine = np.maximum(lights.direction.astype(float) @ normal.T, 0)
    images = (albedo[:, None] / np.pi * lights.irradiance.T[:, :, None] * cosine).astype(np.float16)
    return Scene(lights, images.astype(float), normal, albedo, packs.upload(images, device=device))


def _weights(scene: Scene) -> np.ndarray:
    weights = np.random.default_rng(1).random((FRAMES, 3, scene.band.frame_count), dtype=np.float32)
    weights[:, :, LIGHTS:] = 0
    return weights


def one_frame(device: str, scene: Scene) -> Compared:
    """Weighted sum of the images."""
    weights = _weights(scene)[0]
    return combine(scene.band, weights).numpy()[:, :PIXELS], np.einsum("cl,clp->cp", weights, scene.images), FLOAT


def many_frames(device: str, scene: Scene) -> Compared:
    """Weighted sums of the images, several frames at one time."""
    weights = _weights(scene)
    found = combine_batch(scene.band, weights).numpy()[:, :, :PIXELS]
    return found, np.einsum("fcl,clp->fcp", weights, scene.images), FLOAT


def rows(device: str, scene: Scene) -> Compared:
    """Weighted sums of float32 rows."""
    weights = _weights(scene)
    there, _owner = packs.place(scene.images.reshape(-1, PIXELS).astype(np.float32), device)
    return combine_rows(there, weights).numpy()[:, :, :PIXELS], np.einsum("fcl,clp->fcp", weights, scene.images), FLOAT


def grey(device: str, scene: Scene) -> Compared:
    """Grey readings."""
    readings = scene.readings()
    return readings.on_host(readings.values, PIXELS)[:LIGHTS], scene.grey[:LIGHTS], FLOAT


def lambert(device: str, scene: Scene) -> Compared:
    """Least squares normals."""
    fit = solve_lambert(scene.band, scene.readings(), scene.lights.direction)
    twin = np.array([np.linalg.lstsq(scene.lights.direction[:LIGHTS][lit], y[lit], rcond=None)[0]
                     for y, lit in ((y, y > 0) for y in scene.grey[:LIGHTS].T)])
    return fit.normal.numpy()[:, :PIXELS].T, twin / np.linalg.norm(twin, axis=1, keepdims=True), 10 * FLOAT


def robust(device: str, scene: Scene) -> Compared:
    """Normals without two highlights and a shadow at each pixel."""
    images, rng = scene.images.copy(), np.random.default_rng(2)
    for pixel in range(PIXELS):
        bright, other, dark = rng.choice(LIGHTS, 3, replace=False)
        images[:, [bright, other], pixel] *= 3
        images[:, dark, pixel] *= 0.05
    band = packs.upload(images.astype(np.float16), device=device)
    fit = solve_robust(band, grey_readings(band, scene.factors), scene.lights.direction)
    return fit.normal.numpy()[:, :PIXELS].T, scene.normal, 10 * HALF


def albedo(device: str, scene: Scene) -> Compared:
    """Albedo under the normals of least squares."""
    readings = scene.readings()
    fit = solve_lambert(scene.band, readings, scene.lights.direction)
    return fit_albedo(scene.band, readings, fit, scene.lights).albedo.numpy()[:, :PIXELS], scene.albedo, HALF


def near(device: str, scene: Scene) -> Compared:
    """Directions to near lights."""
    place = np.column_stack([3 * scene.lights.direction[:LIGHTS], np.ones(LIGHTS)])
    points = 0.1 * scene.normal.T
    seen = see_near(scene.band, readings := scene.readings(), NearField(pad_places(place, np.zeros_like(place)), points.astype(np.float32)))
    toward = place[None, :, :3] - points.T[:, None]
    twin = np.moveaxis(toward / np.linalg.norm(toward, axis=-1, keepdims=True), 0, -1)
    return np.moveaxis(readings.on_host(seen.toward, PIXELS)[:, :LIGHTS], 0, 1), twin, FLOAT


def gathered(device: str, scene: Scene) -> Compared:
    """Readings of sampled pixels."""
    return readings_of(scene.samples()), scene.grey[:LIGHTS].T, FLOAT


def chosen(device: str, scene: Scene) -> Compared:
    """Samples of every third pixel."""
    return readings_of(choose(scene.samples(), np.arange(PIXELS) % 3 == 0)), scene.grey[:LIGHTS].T[::3], FLOAT


def svbrdf(device: str, scene: Scene) -> Compared:
    """Normals that the general search finds on a matt surface; it is as fine as its last steps."""
    return solve_svbrdf(scene.samples(), scene.normal.astype(np.float32), shape=LobeShape()).normal, scene.normal, 10 * HALF


def moments(device: str, scene: Scene) -> Compared:
    """Responses to gradient illumination."""
    means = np.zeros((scene.band.frame_count, 4))
    means[:LIGHTS, 0] = 0.5
    means[np.arange(LIGHTS), 1 + np.arange(LIGHTS) % 3] = np.where(np.arange(LIGHTS) % 2, 0.4, -0.4)
    fit = fit_moments(scene.band, means, np.ones(len(means)), GREY)
    twin = np.concatenate([np.linalg.lstsq(means[:LIGHTS], plane[:LIGHTS], rcond=None)[0] for plane in scene.images])
    return fit.values.numpy()[:, :PIXELS], twin, 10 * FLOAT


def products(device: str, scene: Scene) -> Compared:
    """Inner products of the images."""
    return gram(scene.band, np.ones(PIXELS, dtype=bool)), np.einsum("clp,cmp->clm", scene.images, scene.images), FLOAT


def residual(device: str, scene: Scene) -> Compared:
    """Squared difference of the images from rebuilt ones."""
    rng = np.random.default_rng(3)
    functions, terms = rng.random((3, scene.band.frame_count, 2), dtype=np.float32), rng.random((2, 3, scene.band.packs), dtype=np.float32)
    terms = np.repeat(terms, packs.padded_count(PIXELS, device) // scene.band.packs, axis=2)
    gains = np.ones((3, scene.band.frame_count), dtype=np.float32)
    found = squared_residual(scene.band, gains, wp.array(terms, dtype=wp.float32, device=device), functions).numpy()
    twin = ((scene.images - np.einsum("clt,tcp->clp", functions, terms[:, :, :PIXELS])) ** 2).sum(axis=1)
    return found[:, :PIXELS], twin, FLOAT


def nearest(device: str, scene: Scene) -> Compared:
    """Lights nearest to the texels of a map, where no border is near."""
    grid, directions = cut(64, 128), scene.lights.direction[:LIGHTS]
    found = nearest_light(grid, directions, device=device)
    sine, up = np.sin(grid.polar)[:, None], np.cos(grid.polar)[:, None]
    toward = np.stack([sine * np.sin(grid.azimuth), up + 0 * grid.azimuth, -sine * np.cos(grid.azimuth)], axis=-1)
    return found.light[~found.crossed], (toward @ directions.T).argmax(axis=-1)[~found.crossed], 0


def _columns() -> np.ndarray:
    return np.random.default_rng(4).uniform(1, WIDTH - 1, PIXELS)


def _waves(device: str) -> tuple[Band, list[float], list[float]]:
    """Return frames of phases, and the period and the shift of each."""
    periods, shifts = np.repeat(PERIODS, STEPS).tolist(), [step / STEPS for step in range(STEPS)] * len(PERIODS)
    shown = np.cos(2 * np.pi * (_columns() / np.array(periods)[:, None] - np.array(shifts)[:, None]))
    return upload((0.45 + 0.35 * shown).astype(np.float32), device=device), periods, shifts


def phase(device: str, scene: Scene) -> Compared:
    """Wrapped phases, as points of the unit circle."""
    frames, periods, shifts = _waves(device)
    found = decode_phase(frames, range(len(periods)), periods, shifts, noise=NOISE).phase.numpy()[:, :PIXELS]
    return np.exp(1j * found), np.exp(2j * np.pi * _columns() / np.array(PERIODS)[:, None]), FLOAT


def column(device: str, scene: Scene) -> Compared:
    """Columns from the phases of four periods."""
    frames, periods, shifts = _waves(device)
    found = unwrap_jointly(decode_phase(frames, range(len(periods)), periods, shifts, noise=NOISE), extent=WIDTH)
    return found.coordinate.numpy()[:PIXELS], _columns(), FLOAT


def gray(device: str, scene: Scene) -> Compared:
    """Middles of the stripes of a Gray code with inverses."""
    stripe = np.floor(_columns()).astype(int)
    bits = (stripe ^ stripe >> 1) >> np.arange(11)[:, None] & 1
    frames = upload((0.1 + 0.7 * np.concatenate([bits, 1 - bits])).astype(np.float32), device=device)
    return decode_gray(frames, range(11), range(11, 22), extent=WIDTH, noise=NOISE).coordinate.numpy()[:PIXELS], stripe + 0.5, 0


def ramp(device: str, scene: Scene) -> Compared:
    """Columns from a rising and a falling ramp."""
    at = _columns() / WIDTH
    frames = upload((0.1 + 0.7 * np.stack([at, 1 - at, 0 * at])).astype(np.float32), device=device)
    found = decode_ramp(frames, up=0, down=1, black=2, extent=WIDTH, noise=NOISE).coordinate.numpy()
    return found[:PIXELS], _columns(), FLOAT


def parts(device: str, scene: Scene) -> Compared:
    """Direct and global light under shifted stripes."""
    light = np.random.default_rng(5).uniform(0.1, 0.4, (2, PIXELS))
    stripes = 1 + np.cos(2 * np.pi * (_columns() / 8 - np.arange(STEPS)[:, None] / STEPS))
    frames = upload(((light[0] * stripes + light[1]) / 2).astype(np.float32), device=device)
    found = separate(frames, range(STEPS), [step / STEPS for step in range(STEPS)], period_px=8)
    return np.concatenate([found.direct.numpy()[:, :PIXELS], found.indirect.numpy()[:, :PIXELS]]), light, FLOAT


def depths(device: str, scene: Scene) -> Compared:
    """Depths by triangulation: a projector 0.2 m beside the camera sees a point of depth z at x − 0.2 / z."""
    x, y, depth = *np.random.default_rng(6).uniform(-0.3, 0.3, (2, PIXELS)), np.random.default_rng(7).uniform(1, 2, PIXELS)
    pose = np.array([[1, 0, 0, -0.2], [0, -1, 0, 0], [0, 0, -1, 0]], dtype=float)
    projector = ProjectorModel((WIDTH, 800.0), (1000.0, 1000.0), (640.0, 400.0), (0.0, 0.0, 0.0), (0.0, 0.0), pose)
    held = np.zeros(packs.padded_count(PIXELS, device), dtype=np.float32)
    held[:PIXELS] = 640 + 1000 * (x - 0.2 / depth)
    decoded = Decoded(*(wp.array(values, dtype=kind, device=device) for values, kind in (
        (held, wp.float32), (np.full_like(held, 0.1), wp.float32), (np.ones_like(held), wp.float32),
        (np.full(len(held), Status.OK, dtype=np.uint8), wp.uint8))))
    found = triangulate(x.astype(np.float32), y.astype(np.float32), decoded, None, projector, near_m=0.1, far_m=10.0, max_residual_px=3.0,
                        device=device)
    return found.depth.numpy()[:PIXELS], depth, 10 * FLOAT


HZ = np.repeat([16e6, 80e6, 120e6], 3)
DELTA = np.tile(2 * np.pi * np.arange(3) / 3, 3)


def _distance_phase() -> np.ndarray:
    return 4 * np.pi * np.unique(HZ)[:, None] / 299792458.0 * np.random.default_rng(8).uniform(0.5, 9, PIXELS)


def flight(device: str, scene: Scene) -> Compared:
    """Phases of time of flight, as points of the unit circle."""
    raw = 1000 + 300 * np.cos(np.repeat(_distance_phase(), 3, axis=0) - DELTA[:, None])
    found = decode(raw.astype(np.float32), HZ, DELTA, noise=Noise(1.0, 5.0), device=device)
    return np.exp(1j * found.phase.numpy()[:, :PIXELS]), np.exp(1j * _distance_phase()), FLOAT


def wiggling(device: str, scene: Scene) -> Compared:
    """The same phases without the harmonics of a table."""
    raw = 1000 + 300 * np.cos(np.repeat(_distance_phase(), 3, axis=0) - DELTA[:, None])
    found = decode(raw.astype(np.float32), HZ, DELTA, noise=Noise(1.0, 5.0), device=device)
    before = found.phase.numpy()[:, :PIXELS].astype(float)
    table = np.stack([sample_harmonics(np.zeros(5), np.array([0, 0, 0, 0, size])) for size in (0.02, 0.05, 0.1)]).astype(np.float32)
    at = before / (2 * np.pi) * ENTRIES
    low, part = np.floor(at).astype(int), at % 1
    twin = before - np.stack([(1 - part[f]) * table[f, low[f] % ENTRIES] + part[f] * table[f, (low[f] + 1) % ENTRIES] for f in range(3)])
    return np.exp(1j * straighten(found, table).phase.numpy()[:, :PIXELS]), np.exp(1j * twin), FLOAT


def height(device: str, scene: Scene) -> Compared:
    """Height of a paraboloid from its normals, whose slopes midway between pixels are the means of theirs."""
    side = 61
    y, x = (plane.astype(np.float32) for plane in np.mgrid[side / 2 : -side / 2 : -1, -side / 2 : side / 2])
    normal = np.stack([x / side, y / side, np.ones_like(x)])
    mask = x * x + y * y < (0.45 * side) ** 2
    found = integrate_normals((normal / np.linalg.norm(normal, axis=0)).astype(np.float32), mask, x, y, perspective=False, mean_z=0.0,
                              device=device).height.numpy().reshape(side, side)
    true = -(x * x + y * y) / (2 * side)
    return found[mask], (true - true[mask].mean())[mask], HALF


CHECKS: tuple[Callable[[str, Scene], Compared], ...] = (
    one_frame, many_frames, rows, grey, lambert, robust, albedo, near, gathered, chosen, svbrdf, moments, products, residual, nearest,
    phase, column, gray, ramp, parts, depths, flight, wiggling, height)


def wrong(device: str) -> Iterator[str]:
    """Yield a line for each kernel that is not what its twin says."""
    scene = make_scene(device)
    for check in CHECKS:
        found, twin, tolerance = check(device, scene)
        off = float(np.abs(found - twin).max() / np.abs(twin).max()) if found.shape == twin.shape else np.inf
        if not off <= tolerance:
            yield f"{check.__name__}: off by {off:.1e} of the largest value, {tolerance:.0e} is allowed: {check.__doc__}"
