"""Slow float64 twins of the relighting kernels; they import nothing of ours."""

import numpy as np


def rotation_about_y(degrees):
    """Turns about +y, positive from +z towards +x; turned = rotation @ direction."""
    t = np.radians(degrees)
    return np.array([[np.cos(t), 0, np.sin(t)], [0, 1, 0], [-np.sin(t), 0, np.cos(t)]])


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


def cell_energy(environment, directions, rotation, *, down, across):
    """Energy [light, 3] and solid angle [light] of each light's cell: each texel is cut into down x across samples, and each
    sample, turned by the rotation, goes to the light with the largest cosine. A texel keeps its contract solid angle."""
    rows, cols, _ = environment.shape
    turned = texel_directions(rows * down, cols * across) @ rotation.T
    nearest = np.argmax(turned @ directions.T, axis=-1)
    fine = texel_solid_angles(rows * down, cols * across)
    by_texel = fine.reshape(rows, down, cols, across).sum(axis=(1, 3))
    wanted = texel_solid_angles(rows, cols)
    fine = fine * np.kron(wanted / by_texel, np.ones((down, across)))
    energy, solid_angle = np.zeros((len(directions), 3)), np.zeros(len(directions))
    for light in range(len(directions)):
        share = np.where(nearest == light, fine, 0).reshape(rows, down, cols, across).sum(axis=(1, 3))
        solid_angle[light] = share.sum()
        energy[light] = (share[..., None] * environment).sum(axis=(0, 1))
    return energy, solid_angle
