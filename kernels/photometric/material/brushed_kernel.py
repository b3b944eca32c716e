"""Levenberg-Marquardt steps of the normal and the streak of a brushed surface, a thread for each pixel.

The lobe is anisotropic GGX with two widths along and across a tangent. Seven unknowns, five of them not linear, are fitted to re-weighted
grey readings; after each step albedo and F0 follow from least squares. Derivatives are differences of responses.

Sources: Heitz, "Understanding the masking-shadowing function in microfacet-based BRDFs", JCGT 2014, equations 85 (distribution), 86 and 99
(height-correlated masking); Marquardt, SIAM Journal 1963; weights as in hypotheses; variances after MacKinnon and White, "Some
heteroskedasticity-consistent covariance matrix estimators", Journal of Econometrics 1985 (HC3): a streak is told by few, bright readings.
"""

import warp as wp

from kernels.elementary import log_of
from kernels.microfacet import INVERSE_PI, diffuse, schlick
from kernels.photometric.model.candidates import LEAST_NZ
from kernels.photometric.model.robust_weights import Criteria, weigh_grey
from kernels.photometric.search.refine import active

START = 8
"""Values of a lobe: normal, tangent, and the widths α along and across the tangent."""
UNKNOWNS = 7
"""Tilts along and across the tangent, logarithms of both widths, turn of the tangent, albedo, F0."""
CURVED = UNKNOWNS - 2
"""Those that the readings do not depend on linearly."""
STEPS = 16
"""Number of steps, including those that are undone, from each of two starts."""
APART = 0.966
"""Cosine of the least angle, 15 degrees, between the normals of the two starts from which steps are taken."""
DAMPING, DAMPING_UP, DAMPING_DOWN = 0.1, 6.0, 0.3
"""Initial damping, and the factors on it after a step that raised and one that lowered the cost."""
LONGEST_TILT, LONGEST_CHANGE = 0.1, 0.4
"""Largest change of a tilt, and of the other unknowns that are not linear, in one step."""
NUDGE = 2e-3
"""Change of an unknown by which its derivative is taken."""
NARROWEST, WIDEST = 0.02, 1.0
"""Least and largest width α."""
LEAST_PIVOT, LEAST_DIAGONAL, HELD_DIAGONAL = 1e-5, 1e-12, 1e6
"""Least part of an unknown's diagonal that the others leave; less is rounding. A diagonal below the second belongs to an unknown at its
bound, which the third holds there."""
LEAST_FREE = 0.1
"""Least part of a reading's misfit that the unknowns do not follow."""

Lobe = wp.types.vector(length=START, dtype=wp.float32)
Square = wp.types.matrix(shape=(UNKNOWNS, UNKNOWNS), dtype=wp.float32)
Column = wp.types.vector(length=UNKNOWNS, dtype=wp.float32)
Sums = wp.types.vector(length=5, dtype=wp.float32)


@wp.struct
class Readings:
    """The readings of all pixels, and what they are judged by."""

    grey: wp.array2d(dtype=float)  # [L, n]; below 0 where there is no reading
    colour: wp.array3d(dtype=float)  # [3, L, n]
    toward: wp.array3d(dtype=float)  # [3, L, n]
    view: wp.array2d(dtype=float)  # [3, n]
    level: wp.array(dtype=float)  # [n]


@wp.func
def streak(lobe: Lobe, light: wp.vec3, v: wp.vec3) -> float:
    """Return D · V · n·l of a lobe without Fresnel, seen from v; 0 for a light below the horizon."""
    n, t = wp.vec3(lobe[0], lobe[1], lobe[2]), wp.vec3(lobe[3], lobe[4], lobe[5])
    b = wp.cross(n, t)
    h = wp.normalize(light + v)
    along, across = lobe[6], lobe[7]
    nl, nv, nh = wp.dot(n, light), wp.max(wp.dot(n, v), 1.0e-3), wp.dot(n, h)
    th, bh = wp.dot(t, h) / along, wp.dot(b, h) / across
    q = th * th + bh * bh + nh * nh
    lit = wp.length(wp.vec3(along * wp.dot(t, light), across * wp.dot(b, light), nl))
    seen = wp.length(wp.vec3(along * wp.dot(t, v), across * wp.dot(b, v), nv))
    value = wp.static(0.5 * INVERSE_PI) * nl / (along * across * q * q * wp.max(nl * seen + nv * lit, 1.0e-6))
    return wp.where(nl > 0.0, value, 0.0)


@wp.func
def responses(lobe: Lobe, light: wp.vec3, v: wp.vec3, form: wp.vec4):
    """Return the responses to an albedo of one and to F0, and what of a reading depends on neither."""
    n = wp.vec3(lobe[0], lobe[1], lobe[2])
    hv2 = wp.max(0.5 + 0.5 * wp.dot(light, v), 2.5e-7)
    value = streak(lobe, light, v)
    fixed = schlick(wp.sqrt(hv2)) * value
    return INVERSE_PI * diffuse(wp.max(wp.dot(n, light), 0.0), wp.max(wp.dot(n, v), 1.0e-3), hv2, form), value - fixed, fixed


@wp.func
def changed(lobe: Lobe, step: Column, v: wp.vec3) -> Lobe:
    """Return a lobe after a step of the unknowns, its normal facing the viewer v and its tangent perpendicular to it."""
    n, t = wp.vec3(lobe[0], lobe[1], lobe[2]), wp.vec3(lobe[3], lobe[4], lobe[5])
    b = wp.cross(n, t)
    to = n + step[0] * t + step[1] * b
    to = wp.normalize(to + wp.max(LEAST_NZ - wp.dot(to, v), 0.0) * v)
    along = t + step[4] * b
    along = wp.normalize(along - wp.dot(along, to) * to)
    return Lobe(to[0], to[1], to[2], along[0], along[1], along[2], wp.clamp(lobe[6] * wp.exp(step[2]), NARROWEST, WIDEST),
                wp.clamp(lobe[7] * wp.exp(step[3]), NARROWEST, WIDEST))


@wp.func
def nudged(lobe: Lobe, unknown: int, v: wp.vec3, round_lobe: int) -> Lobe:
    """Return a lobe of which one unknown is changed by NUDGE; of a round one both widths."""
    step = Column()
    step[unknown] = NUDGE
    if round_lobe == 1 and unknown == 2:
        step[3] = NUDGE
    return changed(lobe, step, v)


@wp.func
def light_at(readings: Readings, light: int, i: int) -> wp.vec3:
    """Return the direction to a light from a pixel."""
    return wp.vec3(readings.toward[0, light, i], readings.toward[1, light, i], readings.toward[2, light, i])


@wp.func
def one_over_noise(y: float, level: float, criteria: Criteria) -> float:
    """Return 1 / σ of a reading."""
    return 1.0 / (criteria.noise[0] * level + criteria.noise[1] * wp.max(y, 0.0))


@wp.func
def weight_of(y: float, predicted: float, level: float, criteria: Criteria):
    """Return the weight of a reading in a robust fit, and the exponential of its cost."""
    sigma = one_over_noise(y, level, criteria)
    off = (y - predicted) * sigma
    w, factor = weigh_grey(y, predicted, off * off, wp.where(y < 0.0, 0.0, 1.0), sigma, criteria.shadow)
    return w, factor


@wp.func
def products(w: float, fd: float, fs: float, left: float) -> Sums:
    """Return what a reading of weight w adds to the normal equations of albedo and F0; `left` is what both explain together."""
    return Sums(w * fd * fd, w * fd * fs, w * fs * fs, w * fd * left, w * fs * left)


@wp.func
def two_unknowns(sums: Sums):
    """Return the albedo, 0 or more, and the F0, 0 to 1, of normal equations."""
    dd, ds, ss, rd, rs = sums[0], sums[1], sums[2], sums[3], sums[4]
    d_on, s_on = active(dd, ds, ss, rd, rs)
    inverse = d_on / wp.max(dd, 1.0e-20)
    shine = wp.clamp(s_on * (rs - inverse * ds * rd) / wp.max(ss - inverse * ds * ds, 1.0e-20), 0.0, 1.0)
    return wp.max(inverse * (rd - ds * shine), 0.0), shine


@wp.func
def plain_fit(readings: Readings, i: int, lobe: Lobe, criteria: Criteria):
    """Return albedo and F0 of a lobe by least squares with weights of the noise alone, and the weighted squares that are left."""
    v, level = wp.vec3(readings.view[0, i], readings.view[1, i], readings.view[2, i]), readings.level[i]
    sums, yy = Sums(), float(0.0)
    for light in range(readings.grey.shape[0]):
        y = readings.grey[light, i]
        fd, fs, fixed = responses(lobe, light_at(readings, light, i), v, criteria.form)
        sigma = wp.where(y < 0.0, 0.0, one_over_noise(y, level, criteria))
        w = sigma * sigma
        left = y - fixed
        sums += products(w, fd, fs, left)
        yy += w * left * left
    rho, f0 = two_unknowns(sums)
    return rho, f0, yy - rho * (2.0 * sums[3] - rho * sums[0] - 2.0 * f0 * sums[1]) - f0 * (2.0 * sums[4] - f0 * sums[2])


@wp.func
def robust_fit(readings: Readings, i: int, lobe: Lobe, first_rho: float, first_f0: float, criteria: Criteria):
    """Return albedo and F0 of a lobe after two rounds of the robust fit, and their cost."""
    v, level = wp.vec3(readings.view[0, i], readings.view[1, i], readings.view[2, i]), readings.level[i]
    rho, f0, cost = float(first_rho), float(first_f0), float(0.0)
    for turn in range(3):
        cost = float(0.0)
        sums = Sums()
        for light in range(readings.grey.shape[0]):
            y = readings.grey[light, i]
            fd, fs, fixed = responses(lobe, light_at(readings, light, i), v, criteria.form)
            w, factor = weight_of(y, rho * fd + f0 * fs + fixed, level, criteria)
            cost += log_of(factor)
            sums += products(w, fd, fs, y - fixed)
        if turn < 2:
            rho, f0 = two_unknowns(sums)
    return rho, f0, cost


@wp.func
def slopes_at(readings: Readings, light: int, i: int, lobe: Lobe, rho: float, f0: float, criteria: Criteria, round_lobe: int):
    """Return the derivatives of a reading by the unknowns, what the lobe leaves of it, and its weight."""
    v = wp.vec3(readings.view[0, i], readings.view[1, i], readings.view[2, i])
    y, toward = readings.grey[light, i], light_at(readings, light, i)
    fd, fs, fixed = responses(lobe, toward, v, criteria.form)
    left = y - (rho * fd + f0 * fs + fixed)
    w, _factor = weight_of(y, y - left, readings.level[i], criteria)
    slopes = Column()
    for u in range(CURVED):
        if round_lobe == 0 or u < 3:
            nd, ns, nf = responses(nudged(lobe, u, v, round_lobe), toward, v, criteria.form)
            slopes[u] = (rho * (nd - fd) + f0 * (ns - fs) + nf - fixed) / NUDGE
    slopes[CURVED] = wp.where(rho > 0.0, fd, 0.0)
    slopes[CURVED + 1] = wp.where(f0 > 0.0, fs, 0.0)
    return slopes, left, w


@wp.func
def normal_equations(readings: Readings, i: int, lobe: Lobe, rho: float, f0: float, criteria: Criteria, round_lobe: int):
    """Return the matrix, its lower half, and the right side of a step."""
    square, right = Square(), Column()
    for light in range(readings.grey.shape[0]):
        slopes, left, w = slopes_at(readings, light, i, lobe, rho, f0, criteria, round_lobe)
        for row in range(UNKNOWNS):
            right[row] += w * slopes[row] * left
            for col in range(row + 1):
                square[row, col] += w * slopes[row] * slopes[col]
    for row in range(UNKNOWNS):
        square[row, row] = wp.where(square[row, row] > LEAST_DIAGONAL, square[row, row], HELD_DIAGONAL)
    return square, right


@wp.func
def solved(square: Square, right: Column) -> Column:
    """Return the solution of a symmetric system with a positive diagonal, of which the lower half is read, by Cholesky's decomposition.
    The unknowns are scaled to a diagonal of one."""
    root, scale, x = Square(), Column(), Column()
    for row in range(UNKNOWNS):
        scale[row] = 1.0 / wp.sqrt(square[row, row])
        for col in range(row + 1):
            left = square[row, col] * scale[row] * scale[col]
            for k in range(col):
                left -= root[row, k] * root[col, k]
            root[row, col] = wp.where(row == col, wp.sqrt(wp.max(left, LEAST_PIVOT)), left / wp.max(root[col, col], 1.0e-6))
        x[row] = right[row] * scale[row]
        for k in range(row):
            x[row] -= root[row, k] * x[k]
        x[row] = x[row] / root[row, row]
    for back in range(UNKNOWNS):
        row = UNKNOWNS - 1 - back
        for k in range(row + 1, UNKNOWNS):
            x[row] -= root[k, row] * x[k]
        x[row] = x[row] / root[row, row]
    for row in range(UNKNOWNS):
        x[row] = x[row] * scale[row]
    return x


@wp.func
def variances(readings: Readings, i: int, lobe: Lobe, rho: float, f0: float, criteria: Criteria, round_lobe: int):
    """Return the variances of the normal, both tilts together, and of the albedo: the squares by which leaving out each reading changes
    them."""
    square, _right = normal_equations(readings, i, lobe, rho, f0, criteria, round_lobe)
    normal, albedo = float(0.0), float(0.0)
    for light in range(readings.grey.shape[0]):
        slopes, left, w = slopes_at(readings, light, i, lobe, rho, f0, criteria, round_lobe)
        moves = solved(square, slopes)
        by = w * left / wp.max(1.0 - w * wp.dot(slopes, moves), LEAST_FREE)
        normal += by * by * (moves[0] * moves[0] + moves[1] * moves[1])
        albedo += by * by * moves[CURVED] * moves[CURVED]
    return normal, albedo


@wp.func
def given_start(starts: wp.array3d(dtype=float), start: int, i: int) -> Lobe:
    """Return a start of a pixel."""
    lobe, at = Lobe(), wp.min(i, starts.shape[2] - 1)
    for k in range(START):
        lobe[k] = starts[start, k, at]
    return lobe


@wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 0})
def brushed_kernel(first: int,
                   readings: Readings,
                   starts: wp.array3d(dtype=float),  # [S, START, 1 or n]
                   criteria: Criteria,
                   round_lobe: int,
                   # outputs
                   fitted: wp.array2d(dtype=float)):  # [17, n] lobe, cost, albedo, F0, variance of the normal and of the albedo
    """Choose two of the starts of a pixel, follow both, and write the better end."""
    i = first + wp.tid()
    v = wp.vec3(readings.view[0, i], readings.view[1, i], readings.view[2, i])
    one, other = Lobe(), Lobe()
    one_cost, other_cost = float(1.0e30), float(1.0e30)
    for s in range(starts.shape[0]):
        start = changed(given_start(starts, s, i), Column(), v)
        _rho, _f0, cost = plain_fit(readings, i, start, criteria)
        near = start[0] * one[0] + start[1] * one[1] + start[2] * one[2] > APART
        if cost < one_cost:
            if not near:
                other = one
                other_cost = one_cost
            one = start
            one_cost = cost
        elif cost < other_cost and not near:
            other = start
            other_cost = cost
    best, best_rho, best_f0, best_cost = Lobe(), float(0.0), float(0.0), float(1.0e30)
    for follow in range(2):
        if follow == 0 or other_cost < 1.0e30:
            here = wp.where(follow == 0, one, other)
            rho, f0, _left = plain_fit(readings, i, here, criteria)
            rho, f0, cost = robust_fit(readings, i, here, rho, f0, criteria)
            square, right = normal_equations(readings, i, here, rho, f0, criteria, round_lobe)
            damping = float(DAMPING)
            for _step in range(STEPS):
                damped = square
                for row in range(UNKNOWNS):
                    damped[row, row] = square[row, row] * (1.0 + damping)
                step = solved(damped, right)
                for u in range(CURVED):
                    longest = wp.where(u < 2, LONGEST_TILT, LONGEST_CHANGE)
                    step[u] = wp.clamp(step[u], -longest, longest)
                if round_lobe == 1:
                    step[3] = step[2]
                there = changed(here, step, v)
                new_rho, new_f0, new_cost = robust_fit(readings, i, there, rho, f0, criteria)
                damping = damping * DAMPING_UP
                if new_cost < cost:
                    here = there
                    rho = new_rho
                    f0 = new_f0
                    cost = new_cost
                    damping = wp.max(damping * wp.static(DAMPING_DOWN / DAMPING_UP), 1.0e-6)
                    square, right = normal_equations(readings, i, here, rho, f0, criteria, round_lobe)
            if cost < best_cost:
                best = here
                best_rho = rho
                best_f0 = f0
                best_cost = cost
    for k in range(START):
        fitted[k, i] = best[k]
    fitted[START, i] = best_cost
    normal_variance, albedo_variance = variances(readings, i, best, best_rho, best_f0, criteria, round_lobe)
    fitted[START + 7, i] = normal_variance
    fitted[START + 8, i] = albedo_variance
    for c in range(3):
        sums = Sums()
        for light in range(readings.grey.shape[0]):
            y = readings.grey[light, i]
            fd, fs, fixed = responses(best, light_at(readings, light, i), v, criteria.form)
            w, _factor = weight_of(y, best_rho * fd + best_f0 * fs + fixed, readings.level[i], criteria)
            sums += products(w, fd, fs, readings.colour[c, light, i] - fixed)
        rho_c, f0_c = two_unknowns(sums)
        fitted[START + 1 + c, i] = rho_c
        fitted[START + 4 + c, i] = f0_c
