"""Decoded projector coordinates → depth: the point of each line of sight that the projector sees at that column, row or both.

A point at inverse depth s along the line of sight (x, y, -1) of a camera pixel lies, up to a factor, at q = a + b s in the
projector's device frame, where a turns with the pixel and b is the camera's centre. Its image (u, v) in the projector is that of an
ordinary camera, lens distortion included, so that the column of constant u is curved where the lens makes it so. Without distortion
u(s) is a ratio of two linear functions and s follows at once; from there Gauss-Newton steps on the distorted image find the s whose
u, v or both are those decoded, weighted by their variances. The inverse depth is what a projector coordinate is nearly linear in.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.pack_access import pack_load
from kernels.packs import as_packs, pack_type, padded_count, zeros
from kernels.status import OK, Status
from kernels.structured.decoded import Decoded

STEPS = 6
"""Number of Gauss-Newton steps; with lenses of ordinary strength (k1 = -0.3) four reach the precision of float32."""
MIN_PARALLAX_PX = 1.0
"""Least distance, in projector pixels, by which a point's image would move if the point were twice as far. With less, the line of sight
lies almost in the sheet of light, and the coordinate does not determine the depth."""
EDGE_MARGIN = 0.01
"""Part of the projector's size by which a point's image may lie outside the projector: calibrations err by as much."""
MISSED_PX = 0.05
"""Largest residual, in projector pixels, of a point found from one axis. With one axis an exact point exists, so that steps with a larger
residual have not converged."""
MISSED_SIGMAS = 3.0
"""Standard deviations of the decoded place by which it may always lie from the point's: coarse codes, such as ramps, scatter farther than
`max_residual_px`."""
MIN_SIGMA_PX = 1.0e-3
"""Least standard deviation of a coordinate, projector pixels, so that a given one of zero does not take all the weight."""

_OUT_OF_RANGE, _ILL_POSED, _AMBIGUOUS = int(Status.OUT_OF_RANGE), int(Status.ILL_POSED), int(Status.AMBIGUOUS)
_UNDECIDED, _MULTIPATH = int(Status.UNDECIDED), int(Status.MULTIPATH)


class ProjectorModel(NamedTuple):
    """Intrinsics and pose of a projector."""

    size: tuple[float, float]  # width, height, pixels
    focal: tuple[float, float]  # pixels
    principal: tuple[float, float]  # continuous coordinates, pixels
    k: tuple[float, float, float]  # radial distortion, OpenCV's k1 k2 k3
    p: tuple[float, float]  # tangential distortion, OpenCV's p1 p2
    projector_from_camera: np.ndarray  # [3, 4] float64: x right, y down, z forward of the projector, from the camera frame


class Triangulation(NamedTuple):
    """Depth of a band; the last axis is pixels, padded to whole packs.

    Pixels with a status of SOLVED have values, and those UNDECIDED or MULTIPATH whose most likely coordinate gives a point.
    """

    depth: wp.array  # [pixels] float32, metres along -z of the camera
    sigma: wp.array  # [pixels] float32, metres: standard deviation that follows from that of the coordinates
    residual: wp.array  # [pixels] float32, projector pixels between the decoded place and that of the point
    status: wp.array  # [pixels] uint8, kernels.status.Status


@wp.struct
class Projection:
    """ProjectorModel on the device."""

    size: wp.vec2
    focal: wp.vec2
    principal: wp.vec2
    k: wp.vec3
    p: wp.vec2
    turn: wp.mat33
    shift: wp.vec3


@wp.struct
class Image:
    """The projector pixel that a point is imaged at, and its derivative by the inverse depth."""

    u: float
    v: float
    du: float
    dv: float
    ahead: float  # z of q: positive in front of the projector
    fold: float  # determinant of the distortion's Jacobian: not positive where the lens model folds back


@wp.func
def project(g: Projection, a: wp.vec3, s: float) -> Image:
    """Return the image of the point at inverse depth s (Brown 1966, as OpenCV writes it)."""
    q = a + g.shift * s
    z = wp.where(wp.abs(q[2]) > 1.0e-12, q[2], 1.0e-12)
    x, y = q[0] / z, q[1] / z
    dx, dy = (g.shift[0] - x * g.shift[2]) / z, (g.shift[1] - y * g.shift[2]) / z
    r2 = x * x + y * y
    radial = 1.0 + r2 * (g.k[0] + r2 * (g.k[1] + r2 * g.k[2]))
    slope = 2.0 * (g.k[0] + r2 * (2.0 * g.k[1] + 3.0 * r2 * g.k[2]))
    xx = radial + x * x * slope + 2.0 * g.p[0] * y + 6.0 * g.p[1] * x
    yy = radial + y * y * slope + 6.0 * g.p[0] * y + 2.0 * g.p[1] * x
    xy = x * y * slope + 2.0 * g.p[0] * x + 2.0 * g.p[1] * y
    image = Image()
    image.u = g.principal[0] + g.focal[0] * (x * radial + 2.0 * g.p[0] * x * y + g.p[1] * (r2 + 2.0 * x * x))
    image.v = g.principal[1] + g.focal[1] * (y * radial + g.p[0] * (r2 + 2.0 * y * y) + 2.0 * g.p[1] * x * y)
    image.du = g.focal[0] * (xx * dx + xy * dy)
    image.dv = g.focal[1] * (xy * dx + yy * dy)
    image.ahead = q[2]
    image.fold = xx * yy - xy * xy
    return image


@wp.struct
class Found:
    """One pixel's result."""

    depth: float
    sigma: float
    residual: float
    status: int


@wp.func
def locate(g: Projection, a: wp.vec3, u: float, v: float, weight_u: float, weight_v: float, near: float, far: float,
           limit: float) -> Found:
    """Return the point on a line of sight that is decoded as (u, v); a weight (1/variance) of zero leaves that axis out."""
    found = Found()
    # without distortion, the axis along which the point moves farther gives the start
    x, y = (u - g.principal[0]) / g.focal[0], (v - g.principal[1]) / g.focal[1]
    by_u, by_v = g.shift[0] - x * g.shift[2], g.shift[1] - y * g.shift[2]
    moves_u = wp.where(weight_u > 0.0, wp.abs(by_u) * g.focal[0], 0.0)
    moves_v = wp.where(weight_v > 0.0, wp.abs(by_v) * g.focal[1], 0.0)
    if wp.max(moves_u, moves_v) <= 0.0:
        found.status = _ILL_POSED
        return found
    s = wp.where(moves_u >= moves_v, (x * a[2] - a[0]) / by_u, (y * a[2] - a[1]) / by_v)
    for _step in range(STEPS):
        at = project(g, a, s)
        slope = weight_u * at.du * at.du + weight_v * at.dv * at.dv
        s += (weight_u * at.du * (u - at.u) + weight_v * at.dv * (v - at.v)) / wp.max(slope, 1.0e-20)
    at = project(g, a, s)
    off_u, off_v = wp.where(weight_u > 0.0, at.u - u, 0.0), wp.where(weight_v > 0.0, at.v - v, 0.0)
    miss = wp.sqrt(off_u * off_u + off_v * off_v)
    explained = weight_u * off_u * off_u + weight_v * off_v * off_v <= MISSED_SIGMAS * MISSED_SIGMAS
    slope = weight_u * at.du * at.du + weight_v * at.dv * at.dv
    way_u, way_v = wp.where(weight_u > 0.0, at.du, 0.0), wp.where(weight_v > 0.0, at.dv, 0.0)
    parallax = wp.abs(s) * wp.sqrt(way_u * way_u + way_v * way_v)
    if not parallax >= MIN_PARALLAX_PX:  # true for NaN too
        found.status = wp.where(s > 0.0, _ILL_POSED, _OUT_OF_RANGE)
        return found
    edge_u, edge_v = EDGE_MARGIN * g.size[0], EDGE_MARGIN * g.size[1]
    lit = at.u > -edge_u and at.u < g.size[0] + edge_u and at.v > -edge_v and at.v < g.size[1] + edge_v
    both = weight_u > 0.0 and weight_v > 0.0
    depth = 1.0 / wp.max(s, 1.0e-12)
    if (s <= 0.0 or at.ahead <= 0.0 or at.fold <= 0.0 or not lit or (miss > wp.where(both, limit, MISSED_PX) and not (both and explained))
            or depth < near or depth > far):
        found.status = _OUT_OF_RANGE
        return found
    found.depth = depth
    found.sigma = depth * depth / wp.sqrt(slope)
    found.residual = miss
    found.status = OK
    return found


@wp.func
def weight_of(code: int, sigma: float) -> float:
    """Return 1 / variance of a coordinate, 0 where it is not decoded."""
    floor = wp.max(sigma, MIN_SIGMA_PX)
    return wp.where(code == OK, 1.0, wp.where(code == _AMBIGUOUS, 1.0, 0.0)) / (floor * floor)


@wp.func
def unsure_weight(code: int, sigma: float) -> float:
    """Return 1 / variance of a coordinate that its decoder keeps without being sure of it, else 0."""
    floor = wp.max(sigma, MIN_SIGMA_PX)
    kept = wp.where(code == _UNDECIDED, 1.0, wp.where(code == _MULTIPATH, 1.0, 0.0))
    return wp.where(sigma > 0.0, kept, 0.0) / (floor * floor)


def triangulate(x: np.ndarray, y: np.ndarray, columns: Decoded | None, rows: Decoded | None, projector: ProjectorModel, *,
                near_m: float, far_m: float, max_residual_px: float, device: str) -> Triangulation:
    """Return the depth of a band from one or both projector coordinates; not synchronised on CUDA.

    OUT_OF_RANGE: behind camera or projector, outside the projector's image, or the axes contradict each other. ILL_POSED: the coordinate
    hardly changes with depth. Else the decoder's status.

    Args:
        x, y: [pixels] where each line of sight crosses z = -1 of the camera frame, lens distortion undone, y up: (x, y, -1) is along it.
        columns, rows: the decoded column u and row v, or None; where both axes are decoded both count, weighted by 1/σ².
        near_m, far_m: range of depths outside which a result is OUT_OF_RANGE.
        max_residual_px: with both axes, how far the decoded place may lie from the point's; beyond that, and beyond three of its standard
            deviations, it is OUT_OF_RANGE.

    Raises:
        ArrayError: neither axis is given, or the counts of pixels differ.

    Source:
        Hartley and Zisserman, "Multiple View Geometry", 2nd edition, section 12.1 (one free parameter: the camera's ray is exact).
    """
    axes = tuple(axis for axis in (columns, rows) if axis is not None)
    if not axes:
        raise ArrayError("neither columns nor rows are given: triangulation needs one decoded axis")
    count = len(x)
    for name, length in [("y", len(y)), *(("a decoded axis", axis.coordinate.shape[0]) for axis in axes)]:
        if length != count and not (name != "y" and length == padded_count(count, device)):
            raise ArrayError(f"{name} has {length} pixels, x has {count}: give one of each for every pixel")
    rays = [_padded(values, count, wp.float32, device) for values in (x, y)]
    planes = [_padded(values, count, dtype, device) for axis in axes
              for values, dtype in ((axis.coordinate, wp.float32), (axis.sigma, wp.float32), (axis.status, wp.uint8))]
    if len(axes) == 1:
        planes = planes * 2  # the kernel of one axis reads one of the two
    result = Triangulation(*(zeros(count, wp.float32, device) for _ in range(3)), zeros(count, wp.uint8, device))
    inputs = [*(as_packs(values, device) for values in (*rays, *planes)), _projection(projector), float(near_m), float(far_m),
              float(max_residual_px)]
    kernel = _kernel(devices.pack_width(device), columns is not None, rows is not None)
    devices.launch(kernel, rays[0].shape[0] // devices.pack_width(device), inputs,
                   [as_packs(array, device) for array in result], device=device)
    return result


def _padded(values: Any, count: int, dtype: Any, device: str) -> wp.array:
    whole = padded_count(count, device)
    if isinstance(values, wp.array) and values.shape[0] == whole and values.dtype == dtype:
        return values
    padded = wp.zeros(whole, dtype=dtype, device=device)
    source = values if isinstance(values, wp.array) else wp.array(values, dtype=dtype, device=device)
    wp.copy(padded, source, count=count)
    return padded


def _projection(model: ProjectorModel) -> Any:
    g = Projection()
    g.size, g.focal, g.principal = wp.vec2(*model.size), wp.vec2(*model.focal), wp.vec2(*model.principal)
    g.k, g.p = wp.vec3(*model.k), wp.vec2(*model.p)
    g.turn = wp.mat33(*model.projector_from_camera[:, :3].ravel().tolist())
    g.shift = wp.vec3(*model.projector_from_camera[:, 3].tolist())
    return g


@once
def _kernel(pack: int, with_u: bool, with_v: bool) -> Any:
    float_pack, code_pack = pack_type(pack, wp.float32), pack_type(pack, wp.uint8)
    load, load_code = pack_load(pack, wp.float32, 1), pack_load(pack, wp.uint8, 1)

    @wp.kernel(enable_backward=False, module="unique")
    def triangulate_kernel(first: int,
                           x: wp.array(dtype=float_pack),  # [P] line of sight (x, y, -1)
                           y: wp.array(dtype=float_pack),  # [P]
                           u: wp.array(dtype=float_pack),  # [P] projector pixels
                           sigma_u: wp.array(dtype=float_pack),  # [P]
                           status_u: wp.array(dtype=code_pack),  # [P]
                           v: wp.array(dtype=float_pack),  # [P]
                           sigma_v: wp.array(dtype=float_pack),  # [P]
                           status_v: wp.array(dtype=code_pack),  # [P]
                           projection: Projection,
                           near: float,
                           far: float,
                           limit: float,
                           # outputs
                           depth: wp.array(dtype=float_pack),  # [P]
                           sigma: wp.array(dtype=float_pack),  # [P]
                           residual: wp.array(dtype=float_pack),  # [P]
                           status: wp.array(dtype=code_pack)):  # [P]
        i = first + wp.tid()
        px, py = load(x, i), load(y, i)
        pu, pv, su, sv = float_pack(), float_pack(), float_pack(), float_pack()
        cu, cv = code_pack(), code_pack()
        if wp.static(with_u):
            pu = load(u, i)
            su = load(sigma_u, i)
            cu = load_code(status_u, i)
        if wp.static(with_v):
            pv = load(v, i)
            sv = load(sigma_v, i)
            cv = load_code(status_v, i)
        zs, ss, rs, codes = float_pack(), float_pack(), float_pack(), code_pack()
        for k in range(pack):
            code_u, code_v = int(cu[k]), int(cv[k])
            weight_u, weight_v = weight_of(code_u, su[k]), weight_of(code_v, sv[k])
            doubtful = weight_u == 0.0 and weight_v == 0.0
            if doubtful:
                weight_u, weight_v = unsure_weight(code_u, su[k]), unsure_weight(code_v, sv[k])
            if weight_u > 0.0 or weight_v > 0.0:
                a = projection.turn * wp.vec3(px[k], py[k], -1.0)
                found = locate(projection, a, pu[k], pv[k], weight_u, weight_v, near, far, limit)
                zs[k] = found.depth
                ss[k] = found.sigma
                rs[k] = found.residual
                code = found.status
                if code == OK and ((weight_u > 0.0 and code_u != OK) or (weight_v > 0.0 and code_v != OK)):
                    code = _AMBIGUOUS
                if doubtful:
                    code = wp.where(code_u > 0, code_u, code_v)
                codes[k] = wp.uint8(code)
            else:
                codes[k] = wp.uint8(wp.where(code_u > 0, code_u, code_v))
        depth[i] = zs
        sigma[i] = ss
        residual[i] = rs
        status[i] = codes

    return triangulate_kernel
