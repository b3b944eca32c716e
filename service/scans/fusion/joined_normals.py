"""A fused surface moved so that it has the photometric normals of its views: low frequencies from depth, high ones from normals.

(1) Where the normals of the surface and the photometric ones differ in the same way over a wide part, the latter have drifted: a light that
stands elsewhere bends them all. The difference is averaged at lengths that double, and each band between two of them corrects the normals
by the share S / (S + N) of it, S being the variance of the drift, N that of the noise of the depth in this band (Wiener 1949).
Vertices at which the two contradict each other (`compared`) count little or nothing in both variances.
(2) Vertices move along the corrected normals until the edges of the mesh are perpendicular to the normals at their ends, held by the depth:
least squares weighted by the variances of both. No band of the motions is larger than the noise of the depth in it.
Edges at vertices that contradict, before or after, do not count at first. Then each edge counts by how well the last solution agrees with
the photometric normals at its ends, in several rounds, so that normals which only the noise of the depth contradicted count again. Where
an edge does not count, its ends move alike, by the variance of the slopes of the depth: a vertex that kept its noise beside neighbours
without theirs would tilt the faces between them by more than either normal errs.

Source: Nehab, Rusinkiewicz, Davis and Ramamoorthi, "Efficiently combining positions and normals for precise 3D geometry", SIGGRAPH 2005
    (sections 3 and 4), whose one scale of correction is replaced by bands; weights of edges by Pinkall and Polthier, "Computing discrete
    minimal surfaces and their conjugates", Experimental Mathematics 2(1), 1993.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, eye_array
from scipy.sparse.linalg import cg

from service.scans.fusion.bands import Bands
from service.scans.fusion.holes import area_vectors, vertex_vectors

BOUND_SIGMAS = 4.0
"""A vertex moves no farther than this many standard deviations of its depth: where normals ask for more, the depth decides."""
ROUNDS = 4
"""Solutions, each without the edges at vertices that would move too far."""
RETURNS = 4
"""Further solutions, in which edges count by how well the one before agrees with the photometric normals."""
DISAGREE = float(np.radians(10.0))
"""Angle between the solution and the photometric normals, radians, at which an edge counts a quarter: as DRIFT."""
LEAST_COTANGENT, MOST_COTANGENT = 0.05, 1e3
"""Bounds of the weights of edges, which thin triangles would make negative or very large."""
BENT = 0.25
"""Standard deviation of the slope of an edge whose normals differ, in squares of their angle: a chord of a curve that is no circle."""
TOLERANCE, MOST_ITERATIONS = 1e-4, 1000
"""Residual of the linear systems as a part of their right side, and the most iterations of conjugate gradients."""
NEAR = 0.2
"""Length in medians below which both ends of an edge move in about one direction: ends that part or meet turn thin faces over."""
MOST_NEAR = 1e4
"""Bound of the weight by which the ends of a short edge share a direction."""

_OfMotions = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Takes the motions [V] of the vertices, metres, and which of these move."""


class Joined(NamedTuple):
    """The moved surface."""

    points: np.ndarray  # [V, 3] float64 metres
    normals: np.ndarray  # [V, 3] float32 unit, corrected; as given where there is no photometric normal
    moved: np.ndarray  # [V] float32 metres along the normal
    used: np.ndarray  # [V] bool, vertices that the normals moved
    contradicted: int
    """Vertices whose photometric normals contradict the surface, or ask for more than its noise explains."""
    drift_degrees: float
    """RMS of the correction of the normals."""


class _Mesh(NamedTuple):
    one: np.ndarray  # [E] int32, first vertex of each edge
    other: np.ndarray  # [E] int32
    weight: np.ndarray  # [E] float64, half the sum of the cotangents of the angles across
    area: np.ndarray  # [V] float64 square metres, a third of the faces around


class _Weights(NamedTuple):
    sigma: np.ndarray  # [V] metres, of the depth
    tilt: np.ndarray  # [V] radians, standard deviation of the photometric normals
    slope: float  # variance of the normals of the depth


def join_normals(points: np.ndarray, faces: np.ndarray, sigma: np.ndarray, normals: np.ndarray, normal_sigma: np.ndarray, *, pixel_m: float
                 ) -> Joined:
    """Move the vertices of a surface so that it has given normals.

    Args:
        sigma: [V] metres, standard deviation of each vertex along its normal; noise is alike within a pixel.
        normals: [V, 3] unit, outwards.
        normal_sigma: [V] radians, standard deviation of the photometric normals; infinite where the normal is none of them.
        pixel_m: distance of neighbouring pixels on the surface.
    """
    known = np.isfinite(normal_sigma)
    inside = np.flatnonzero(known[faces].all(axis=1))
    used = np.zeros(len(points), dtype=bool)
    used[faces[inside]] = True
    if not used.any():
        return Joined(points.copy(), normals, np.zeros(len(points), np.float32), used, 0, 0.0)
    place = np.cumsum(used) - 1
    own, tri = points[used].astype(np.float64), place[faces[inside]]
    spread, given, tilt = sigma[used].astype(np.float64), normals[used].astype(np.float64), normal_sigma[used].astype(np.float64)
    mesh = _mesh(own, tri)
    measured = _face_normals(own, tri)
    bands = Bands(own, measured, mesh.area, pixel_m)
    alike = bands.averaged(np.random.default_rng(0).standard_normal(len(own))[:, None], pixel_m)[:, 0]
    alike *= spread / np.sqrt(np.average(alike**2, weights=mesh.area))
    noise = _face_normals(own + alike[:, None] * given, tri) - measured
    trust = compared(bands, measured - given, noise, pixel_m)
    turned = _corrected(bands, measured, noise, given, trust.counts)
    ways = _ways(own, mesh, turned)
    even = Bands(own, ways, mesh.area, pixel_m)  # its cells mean the same to both ends of a short edge
    weights = _Weights(spread, tilt, bands.variance(noise, np.ones(len(own))))
    move, agree = _moves(own, tri, mesh, weights, ways, turned, trust.agree, lambda move, agree: _limited(even, move, alike, agree),
                         lambda move, agree: unlike_noise(bands, move, spread, agree, pixel_m))
    moved = np.zeros(len(points), dtype=np.float32)
    moved[used] = move
    out, corrected = points.astype(np.float64).copy(), normals.copy()
    out[used] = own + move[:, None] * ways
    corrected[used] = turned
    angle = np.degrees(2 * np.arcsin(np.minimum(np.linalg.norm(turned - given, axis=1) / 2, 1)))
    return Joined(out, corrected, moved, used, int((~agree).sum()), float(np.sqrt(np.average(angle**2, weights=mesh.area * trust.counts))))


def _mesh(points: np.ndarray, faces: np.ndarray) -> _Mesh:
    count = len(points)
    double = np.linalg.norm(area_vectors(points, faces), axis=1)
    area = np.bincount(faces.ravel(), np.repeat(double / 6, 3), minlength=count)
    ends, cotangents = [], []
    for k in range(3):
        corner, left, right = (faces[:, (k + turn) % 3] for turn in range(3))
        along = ((points[left] - points[corner]) * (points[right] - points[corner])).sum(axis=1)
        cotangents.append(along / np.maximum(double, np.finfo(np.float64).tiny) / 2)
        ends.append(np.minimum(left, right).astype(np.int64) * count + np.maximum(left, right))
    edge, number = np.unique(np.concatenate(ends), return_inverse=True)
    weight = np.clip(np.bincount(number, np.concatenate(cotangents)), LEAST_COTANGENT, MOST_COTANGENT)
    return _Mesh((edge // count).astype(np.int32), (edge % count).astype(np.int32), weight, area)


def _face_normals(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the normals [V, 3] of vertices: the normalised sums of the area vectors around."""
    total = vertex_vectors(points, faces)
    return np.asarray(total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), np.finfo(np.float64).tiny))


def _corrected(bands: Bands, measured: np.ndarray, noise: np.ndarray, normals: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the photometric normals without the drift that the depth shows; `noise` is an example of that of the measured normals."""
    correction = np.zeros_like(normals)
    for band in bands.of(np.concatenate([measured - normals, noise], axis=1), counts)[1:]:
        found, expected = bands.variance(band[:, :3], counts), bands.variance(band[:, 3:], counts)
        correction += max(1 - expected / max(found, np.finfo(np.float64).tiny), 0.0) * band[:, :3]
    correction -= normals * (correction * normals).sum(axis=1, keepdims=True)
    turned = normals + correction
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))


def _limited(bands: Bands, move: np.ndarray, noise: np.ndarray, agree: np.ndarray) -> np.ndarray:
    """Return the motions of the vertices, of which no band of lengths above FINEST_PIXELS is larger than the noise of the depth in it.

    What the depth is wrong by has the variance N of its noise. If the motions have more, V, the rest is drift that was left in the normals,
    and N / V of the band is the best estimate (Wiener 1949). Below that length drift is nothing.

    `noise` is an example of that of the depth, metres; `agree` [V] bool are the vertices whose motions are compared.
    """
    fine, *coarse = bands.of(np.stack([move, noise], axis=1), agree)
    out = fine[:, 0].copy()
    for band in coarse:
        found, expected = bands.variance(band[:, :1], agree), bands.variance(band[:, 1:], agree)
        out += min(expected / max(found, np.finfo(np.float64).tiny), 1.0) * band[:, 0]
    return out


def _ways(points: np.ndarray, mesh: _Mesh, normals: np.ndarray) -> np.ndarray:
    """Return the unit directions [V, 3] in which vertices move: their normals, made alike at the ends of short edges."""
    length = np.linalg.norm(points[mesh.one] - points[mesh.other], axis=1)
    alike = np.minimum((NEAR * np.median(length) / np.maximum(length, np.finfo(np.float64).tiny)) ** 2, MOST_NEAR)
    diagonal = 1 + np.bincount(mesh.one, alike, len(points)) + np.bincount(mesh.other, alike, len(points))
    way = np.stack([_solved(mesh, diagonal, -alike, column, column) for column in normals.T], axis=1)
    return np.asarray(way / np.linalg.norm(way, axis=1, keepdims=True))


def _moves(points: np.ndarray, faces: np.ndarray, mesh: _Mesh, weights: _Weights, ways: np.ndarray, normals: np.ndarray, agree: np.ndarray,
           limited: _OfMotions, unlike: _OfMotions) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much each vertex moves, [V] metres, and which vertices do not contradict the normals, [V] bool.

    Args:
        ways: [V, 3] unit, the directions in which the vertices move.
        normals: [V, 3] corrected.
        agree: [V] bool, the vertices whose normals count at first.
        limited: returns the motions without what drift has left in them.
        unlike: returns which motions noise does not explain.

    Source: the weights of edges are those of Geman and McClure (`compared`), found again after each solution.
    """
    one, other, count = mesh.one, mesh.other, len(points)
    middle = normals[one] + normals[other]
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    rise = (middle * (points[other] - points[one])).sum(axis=1)
    at_one, at_other = (middle * ways[one]).sum(axis=1), (middle * ways[other]).sum(axis=1)
    angle = np.linalg.norm(normals[one] - normals[other], axis=1)
    trust = mesh.weight / ((weights.tilt[one] ** 2 + weights.tilt[other] ** 2) / 2 + (BENT * angle**2) ** 2)
    hold = mesh.area / weights.sigma**2
    bound = BOUND_SIGMAS * weights.sigma
    move, found = np.zeros(count), np.zeros(count)

    def solved(counts: np.ndarray) -> np.ndarray:
        weight, still = trust * counts, mesh.weight * (1 - counts) / weights.slope
        diagonal = hold + np.bincount(one, weight * at_one**2 + still, count) + np.bincount(other, weight * at_other**2 + still, count)
        right = np.bincount(one, weight * at_one * rise, count) - np.bincount(other, weight * at_other * rise, count)
        return _solved(mesh, diagonal, -weight * at_one * at_other - still, right, move)

    for _ in range(ROUNDS):
        move = solved((agree[one] & agree[other]).astype(np.float64))
        found = limited(move, agree)
        kept = agree & ~unlike(found, agree) & (np.abs(found) <= bound)
        if (kept == agree).all():
            break
        agree = kept
    for _ in range(RETURNS):
        off = np.linalg.norm(_face_normals(points + found[:, None] * ways, faces) - normals, axis=1)
        off[np.abs(found) > bound] = np.inf
        move = solved(1 / (1 + (np.maximum(off[one], off[other]) / DISAGREE) ** 2) ** 2)
        found = limited(move, agree)
    return np.clip(found, -bound, bound), agree


def _solved(mesh: _Mesh, diagonal: np.ndarray, between: np.ndarray, right: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Solve a symmetric positive system, with one number a vertex and one an edge, by conjugate gradients scaled by the diagonal."""
    root, count = 1 / np.sqrt(diagonal), len(diagonal)
    beside = coo_array((between * root[mesh.one] * root[mesh.other], (mesh.one, mesh.other)), shape=(count, count))
    found, _ = cg((eye_array(count) + beside + beside.T).tocsr(), right * root, first / root, rtol=TOLERANCE, atol=0.0,
                  maxiter=MOST_ITERATIONS)
    return np.asarray(found * root)


# Range images close the mouth of a narrow gap, and make a wall or a ramp of a step between two parts that stand one before the other. The
# photographs show the normals of both parts there and no wall. A surface that was made to have these normals would be drawn from one part
# to the other, and so would what lies beside. Averaged over one to four pixels the two differ there by far more than the noise of the depth
# and the drift of normals.

LENGTHS_PX = (1.0, 2.0, 4.0)
"""Lengths over which normals are compared, pixels: a wall over a step is one or two pixels wide, and longer means have less noise."""
NOISE_PX = 32.0
"""Length over which the variance of the noise is averaged, pixels."""
SIGMAS = 3.0
"""Difference of normals that the noise of the depth explains, in its standard deviations."""
DRIFT = float(np.radians(10.0))
"""Difference, radians, that drift and chords of a bent surface explain: twice the error of lights that `relit join` allows for."""
MOTION_PX = 4.0
"""Length over which motions are compared with the noise, pixels: some 16 of them, so that the mean square of noise is 1 ± .35."""
MOTION = 2.0
"""Largest mean square of motions over that length, in variances of the depth, that noise explains."""


class Trust(NamedTuple):
    """The trust in the normals of the vertices."""

    agree: np.ndarray  # [V] bool, where the normals and the surface do not contradict each other
    counts: np.ndarray  # [V] 0…1, by how much each vertex counts where the drift of the normals is measured


def compared(bands: Bands, difference: np.ndarray, noise: np.ndarray, pixel_m: float) -> Trust:
    """Compare photometric normals with those of the surface, over several lengths.

    Args:
        difference: [V, 3] normals of the mesh without the photometric ones.
        noise: [V, 3] an example of the noise of the former.
        pixel_m: distance of neighbouring pixels on the surface.

    Source: the weights are those of Geman and McClure, "Statistical methods for tomographic image reconstruction", 1987.
    """
    means = [bands.averaged(np.concatenate([difference, noise], axis=1), length * pixel_m) for length in LENGTHS_PX]
    found, example = (np.stack([(mean[:, part] ** 2).sum(axis=1) for mean in means], axis=1) for part in (slice(3), slice(3, 6)))
    ratio = found / (SIGMAS**2 * bands.averaged(example, NOISE_PX * pixel_m) + DRIFT**2)
    return Trust(np.asarray((ratio <= 1).all(axis=1)), np.prod(1 / (1 + ratio) ** 2, axis=1))


def unlike_noise(bands: Bands, move: np.ndarray, sigma: np.ndarray, agree: np.ndarray, pixel_m: float) -> np.ndarray:
    """Return [V] bool, where the motions of the vertices around are larger than the noise of the depth explains.
    `move, sigma`: [V] metres; sigma is the standard deviation of the depth. `agree`: [V] bool, the vertices that moved."""
    return np.asarray(agree & (bands.averaged((move / sigma)[:, None] ** 2, MOTION_PX * pixel_m, agree)[:, 0] > MOTION))
