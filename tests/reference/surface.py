"""Heights from normals, slowly: the same least squares as kernels/surface in float64, solved directly by SciPy."""

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph, linalg

STEEPEST = 0.02


def pair_equations(normal, mask, x, y, *, perspective):
    """Edges (i, j, g, w) over the flat pixels: h_j − h_i = g with weight w; h is z, or −log depth."""
    rows, cols = mask.shape
    normal = np.asarray(normal, dtype=np.float64)
    length = np.linalg.norm(normal, axis=0)
    usable = mask & np.isfinite(length) & (length > 0.5)
    unit = normal / np.where(usable, length, 1.0)
    ray = np.stack([x, y, np.full((rows, cols), -1.0)]).astype(np.float64)
    index = np.arange(rows * cols).reshape(rows, cols)
    spacing = (
        np.hypot(*(np.diff(a[rows // 2] if cols > 1 else a[:, 0]) for a in ray[:2])).mean() if rows * cols > 1 else 1.0
    )
    parts = []
    for here, there in (
        ((slice(None), slice(None, -1)), (slice(None), slice(1, None))),
        ((slice(None, -1), slice(None)), (slice(1, None), slice(None))),
    ):
        both = usable[here] & usable[there]
        i, j = index[here][both], index[there][both]
        m = (unit[(slice(None), *here)] + unit[(slice(None), *there)])[:, both]
        ri, rj = ray[(slice(None), *here)][:, both], ray[(slice(None), *there)][:, both]
        if perspective:
            ai, aj = -(ri * m).sum(0), -(rj * m).sum(0)
            assert (np.minimum(ai, aj) > STEEPEST * np.linalg.norm(m, axis=0) * np.linalg.norm(ri, axis=0)).all()
            g, w = np.log(aj / ai), ai * aj / 4
        else:
            mz = np.maximum(m[2], STEEPEST * np.linalg.norm(m, axis=0))
            g, w = -((rj - ri) * m).sum(0) / mz, mz**2 / 4
        parts.append((i, j, g, np.maximum(w, STEEPEST**2)))
    return usable, spacing, *(np.concatenate(c) for c in zip(*parts, strict=True))


def integrate(normal, mask, x, y, *, perspective, mean_z):
    """Camera-frame z, each 4-connected component with its mean at mean_z; 0 outside."""
    usable, _, i, j, g, w = pair_equations(normal, mask, x, y, perspective=perspective)
    count, edges = mask.size, i.size
    rows = np.tile(np.arange(edges), 2)
    step = sparse.csr_matrix((np.repeat([-1.0, 1.0], edges), (rows, np.concatenate([i, j]))), (edges, count))
    laplacian = (step.T @ sparse.diags(w) @ step).tolil()
    target = step.T @ (w * g)
    parts, label = csgraph.connected_components(step.T @ step, directed=False)
    for pinned in np.unique(label, return_index=True)[1]:  # one pixel of each component (and every pixel outside) at 0
        laplacian[pinned, pinned] += 1.0
        target[pinned] = 0.0
    h = linalg.spsolve(laplacian.tocsc(), target)
    number = np.bincount(label, minlength=parts)
    h -= (np.bincount(label, weights=h, minlength=parts) / number)[label]
    if perspective:
        depth = np.exp(-h)
        h = depth * mean_z / (np.bincount(label, weights=depth, minlength=parts) / number)[label]
    else:
        h += mean_z
    return np.where(usable, h.reshape(mask.shape), 0.0)
