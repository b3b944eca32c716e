"""Slow float64 twins of the relighting kernels; they import nothing of ours."""

import itertools

import numpy as np


def rotation_about_y(degrees):
    """Turns about +y, positive from +z towards +x; turned = rotation @ direction."""
    t = np.radians(degrees)
    return np.array([[np.cos(t), 0, np.sin(t)], [0, 1, 0], [-np.sin(t), 0, np.cos(t)]])


def rotation_about(axis, degrees):
    """Right-handed turn about any axis, after Rodrigues; turned = rotation @ direction."""
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    t = np.radians(degrees)
    return np.eye(3) + np.sin(t) * cross + (1 - np.cos(t)) * cross @ cross


def weighted_sum(stack, weights):
    """[channel, pixel] of stack [channel, light, pixel] and weights [channel, light]."""
    return np.einsum("cl,clp->cp", weights.astype(np.float64), stack.astype(np.float64))


def texel_directions(rows, cols):
    """[rows, cols, 3]: +y up, image centre +z, a quarter from the left +x, left edge -z."""
    v = np.pi * (np.arange(rows) + 0.5)[:, None] / rows
    u = 2 * np.pi * (np.arange(cols) + 0.5)[None, :] / cols
    return np.stack(np.broadcast_arrays(np.sin(u) * np.sin(v), np.cos(v), -np.cos(u) * np.sin(v)), axis=-1)


def texel_solid_angles(rows, cols):
    """[rows, cols] steradians by the contract: sin(πv) · (π/H) · (2π/W)."""
    v = np.pi * (np.arange(rows) + 0.5) / rows
    return np.repeat((np.sin(v) * (np.pi / rows) * (2 * np.pi / cols))[:, None], cols, axis=1)


def samples(environment, rotation, *, down, across):
    """For each row of texels cut into down x across samples: directions [n, 3] turned by the rotation, solid angles [n] by which a
    texel keeps its contract one, radiance [n, 3]."""
    rows, cols, _ = environment.shape
    fine = texel_solid_angles(rows * down, cols * across).reshape(rows, down, cols * across)
    wanted = texel_solid_angles(rows, cols)
    turned = (texel_directions(rows * down, cols * across) @ rotation.T).reshape(rows, -1, 3)
    for row in range(rows):
        solid_angle = fine[row] * np.repeat(wanted[row] / (fine[row, :, 0].sum() * across), across)
        radiance = np.repeat(environment[row], across, axis=0)
        yield turned[row], solid_angle.reshape(-1), np.tile(radiance, (down, 1))


def cell_energy(environment, directions, rotation, *, down, across):
    """Energy [light, 3] and solid angle [light] of each light's cell: each texel is cut into down x across samples, and each
    sample, turned by the rotation, goes whole to the light with the largest cosine."""
    energy, solid_angle = np.zeros((len(directions), 3)), np.zeros(len(directions))
    for turned, weight, radiance in samples(environment, rotation, down=down, across=across):
        nearest = np.argmax(turned @ directions.T, axis=-1)
        np.add.at(solid_angle, nearest, weight)
        np.add.at(energy, nearest, weight[:, None] * radiance)
    return energy, solid_angle


def delaunay_triangles(directions):
    """[face, 3]: every three lights whose plane has all others beneath it, by trying all; none four on one circle."""
    triples = np.array(list(itertools.combinations(range(len(directions)), 3)))
    a, b, c = (directions[triples[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    above = normal @ directions.T - (normal * a).sum(axis=1)[:, None]
    np.put_along_axis(above, triples, 0, axis=1)
    return triples[(above <= 0).all(axis=1) | (above >= 0).all(axis=1)]


def shares_among(lights):
    """A function of unit directions [n, 3]: [n, lights], the coefficients of the Delaunay triangle whose positive combination a direction
    is, scaled to sum one. The lights lie all around: the centre is inside their hull."""
    triangles = delaunay_triangles(lights)
    inverse = np.linalg.inv(lights[triangles].swapaxes(1, 2))

    def shares(direction):
        coefficients = np.einsum("fkx,nx->nfk", inverse, direction)
        face = np.argmax(coefficients.min(axis=2), axis=1)
        share = np.take_along_axis(coefficients, face[:, None, None], axis=1)[:, 0]
        assert share.min() > -1e-12
        whole = np.zeros((len(direction), len(lights)))
        np.put_along_axis(whole, triangles[face], share / share.sum(axis=1, keepdims=True), axis=1)
        return whole

    return shares


def smooth_energy(environment, directions, rotation, *, down, across):
    """Energy [light, 3] and ∫ share dω [light] where each sample is shared among the lights around it."""
    shares = shares_among(directions)
    energy, solid_angle = np.zeros((len(directions), 3)), np.zeros(len(directions))
    for turned, weight, radiance in samples(environment, rotation, down=down, across=across):
        share = shares(turned) * weight[:, None]
        solid_angle += share.sum(axis=0)
        energy += share.T @ radiance
    return energy, solid_angle


def matern(directions, others, of=None):
    """Covariance of smoothness 3/2, whose range is twice the median over the lights of the mean distance to the nearest six."""
    lights = directions if of is None else of
    apart = np.array([[np.linalg.norm(a - b) for b in lights] for a in lights])
    length = 2 * np.median([np.mean(np.sort(row)[1:7]) for row in apart])
    r = np.sqrt(3) * np.array([[np.linalg.norm(a - b) for b in others] for a in directions]) / length
    return (1 + r) * np.exp(-r)


def best_weights(towards, energy, directions):
    """Weights of least expected error among those that are not negative and keep the energy: the best of the solutions on each set of
    lights."""
    count, whole = len(directions), energy.sum()
    between, moment = matern(directions, directions), matern(directions, towards, of=directions) @ energy
    best, least = None, np.inf
    for size in range(1, count + 1):
        for chosen in map(list, itertools.combinations(range(count), size)):
            border = np.ones((size, 1))
            system = np.block([[between[np.ix_(chosen, chosen)], border], [border.T, np.zeros((1, 1))]])
            part = np.linalg.solve(system, np.append(moment[chosen], whole))[:size]
            error = part @ between[np.ix_(chosen, chosen)] @ part - 2 * part @ moment[chosen]
            if part.min() >= 0 and error < least:
                least, best = error, np.zeros(count)
                best[chosen] = part
    return best
