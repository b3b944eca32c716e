"""Viewers of relightable images (RTI) show display values, and sum functions of a light's direction to a pixel.

A stack becomes what a display shows: exposed, in the display's primaries, clipped at white and encoded with the sRGB curve, because such
files hold 8-bit pictures of a camera. The functions are the biquadratic of polynomial texture maps, and hemispherical harmonics; three
fitted channels can be one colour and a luminance function at each pixel (LRGB).

Convention:
    x right, y up, z towards the camera, as everywhere here and in RTI files; lights in front of the object, z > 0.

Source: IEC 61966-2-1:1999, equations for the sRGB transfer function; Malzbender, Gelb and Wolters, "Polynomial Texture Maps", SIGGRAPH
2001: the colour is constant, the luminance follows the light.
"""

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import once
from kernels.errors import ArrayError
from kernels.pack_access import pack_load, pack_store
from kernels.packs import Band, as_packs, pack_type, zeros

PTM_TERMS = 6
"""Number of functions of a polynomial texture map: u², v², u·v, u, v and 1."""
HSH_TERMS = (4, 9, 16)
"""Possible numbers of hemispherical harmonics: order n, from two to four, has n² functions."""
MIN_SPREAD = 1e-3
"""Least ratio of the smallest to the largest singular value of the functions over the lights: below, a coefficient holds a
thousand times the error of a reading."""
ROUNDS = 8
"""Rounds of the power iteration for the colour. It converges by the ratio of the squared eigenvalues, which is ten or more on real
surfaces."""
WHITE = 255.0
"""Value of white in the files, which store a colour in 8 bits."""


class Luminance(NamedTuple):
    """Channel value = colour / 255 · luminance."""

    colour: np.ndarray  # [3, pixels] uint8
    coefficients: np.ndarray  # [terms, pixels] float32, of a luminance whose white is 255


def biquadratic(directions: np.ndarray) -> np.ndarray:
    """Return the six terms [lights, 6] float64 of a polynomial texture map: u², v², u·v, u, v, 1 with u = x, v = y of unit vectors."""
    u, v, _ = np.asarray(directions, dtype=np.float64).T
    return np.stack([u * u, v * v, u * v, u, v, np.ones_like(u)], axis=1)


def hemispherical_harmonics(directions: np.ndarray, terms: int) -> np.ndarray:
    """Return functions that are orthonormal over the hemisphere at [lights, 3] unit vectors to the lights, z ≥ 0.

    Args:
        terms: 4, 9 or 16.

    Returns:
        [lights, terms] float64, by order l and then by m. In order l the cosines come first, the highest m leading, and sines last: cos lφ
        … cos φ, 1, sin φ … sin lφ; functions of even m ≥ 2 carry a minus sign, as RTI files have them.

    Source: Gautron, Křivánek, Pattanaik and Bouatouch, "A Novel Hemispherical Basis for Accurate and Efficient Rendering", EGSR
        2004: associated Legendre polynomials of 2 cos θ − 1.
    """
    if terms not in HSH_TERMS:
        raise ArrayError(f"terms are {terms}: hemispherical harmonics have 4, 9 or 16")
    x, y, z = np.asarray(directions, dtype=np.float64).T
    azimuth, z = np.arctan2(y, x), np.clip(z, 0, 1)
    ring = np.sqrt(z - z * z)  # half the sine of the angle whose cosine is 2z − 1
    one = np.ones_like(z)
    cos, sin = (lambda m: np.cos(m * azimuth)), (lambda m: np.sin(m * azimuth))
    middle, steep = 2 * z - 1, 5 * z * z - 5 * z + 1
    functions = [
        np.sqrt(1 / (2 * np.pi)) * one,
        np.sqrt(6 / np.pi) * ring * cos(1),
        np.sqrt(3 / (2 * np.pi)) * middle,
        np.sqrt(6 / np.pi) * ring * sin(1),
        -np.sqrt(30 / np.pi) * ring**2 * cos(2),
        np.sqrt(30 / np.pi) * middle * ring * cos(1),
        np.sqrt(5 / (2 * np.pi)) * (6 * z * z - 6 * z + 1),
        np.sqrt(30 / np.pi) * middle * ring * sin(1),
        -np.sqrt(30 / np.pi) * ring**2 * sin(2),
        2 * np.sqrt(35 / np.pi) * ring**3 * cos(3),
        -np.sqrt(210 / np.pi) * middle * ring**2 * cos(2),
        2 * np.sqrt(21 / np.pi) * steep * ring * cos(1),
        np.sqrt(7 / (2 * np.pi)) * (20 * z**3 - 30 * z * z + 12 * z - 1),
        2 * np.sqrt(21 / np.pi) * steep * ring * sin(1),
        -np.sqrt(210 / np.pi) * middle * ring**2 * sin(2),
        2 * np.sqrt(35 / np.pi) * ring**3 * sin(3),
    ]
    return np.stack(functions[:terms], axis=1)


def fit_weights(functions: np.ndarray) -> np.ndarray:
    """Return [terms, lights] float64 weights of the images with which their sums are the coefficients of the least-squares fit.

    Raises:
        ArrayError: the lights of functions [lights, terms] do not determine the coefficients.
    """
    lights, terms = functions.shape
    strength = np.linalg.svd(functions, compute_uv=False)
    if lights < terms or strength[-1] < MIN_SPREAD * strength[0]:
        raise ArrayError(f"{lights} lights do not determine {terms} coefficients: spread more of them over the hemisphere")
    return np.linalg.pinv(functions)


def separate(coefficients: np.ndarray, functions: np.ndarray) -> Luminance:
    """Return the product of a colour and a luminance function that is closest to three fitted channels.

    The colour is the one that the brightest of the lights shows, at most white, so that each pixel's luminance reaches 255; 0 where it is
    black.

    Args:
        coefficients: [terms, 3, pixels] float32, of channels whose white is 255.
        functions: [lights, terms] over which closeness is meant.
    """
    moments = functions.T @ functions
    spread = np.einsum("tcp,ts,sdp->pcd", coefficients, moments.astype(np.float32), coefficients, optimize=True)
    colour = np.maximum(np.einsum("t,tcp->pc", functions.sum(axis=0).astype(np.float32), coefficients), 0)
    for _ in range(ROUNDS):
        colour = _unit(np.einsum("pcd,pd->pc", spread, colour))
    colour = _unit(np.maximum(colour, 0))
    along = np.einsum("tcp,pc->tp", coefficients, colour)
    peak = (functions.astype(np.float32) @ along).max(axis=0)
    brightest = np.maximum(colour.max(axis=1), 1e-6)
    reach = np.clip(peak, 0, WHITE / brightest)  # no channel of the colour above white
    stored = np.rint(colour * reach[:, None]).astype(np.uint8)
    exact = stored.astype(np.float32)
    squares = np.maximum((exact * exact).sum(axis=1), 1)
    luminance = np.einsum("tcp,pc->tp", coefficients, exact) * (WHITE / squares)
    return Luminance(np.ascontiguousarray(stored.T), luminance)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-20)


def encode(band: Band, gains: np.ndarray, display_from_stack: np.ndarray) -> Band:
    """Encode every stored image of a band for a display: 0…1, half (off by at most 1/16 of an 8-bit step); not synchronised on CUDA.

    Args:
        gains: [3, lights] exposed scene-linear radiance of a stored 1.0; 0 for padding and for lights to leave out.
        display_from_stack: [3, 3] linear RGB of the display from that of the stack; white is 1.
    """
    band.require_channels(3)
    for name, array, shape in (("gains", gains, (3, band.frame_count)), ("display_from_stack", display_from_stack, (3, 3))):
        if array.shape != shape or not np.isfinite(array).all():
            raise ArrayError(f"{name} are {array.shape}, expected {shape} finite values")
    device = band.device
    pack = devices.pack_width(device)
    encoded = zeros(band.pixel_count, wp.float16, device, rows=3 * band.frame_count)
    on_device = wp.array(gains, dtype=wp.float32, device=device)
    matrix = wp.mat33(*(float(v) for v in np.asarray(display_from_stack, dtype=np.float32).reshape(-1)))
    packed = as_packs(encoded, device)
    devices.launch(encode_kernel(pack), band.frame_count * band.packs, [band.values, on_device, matrix], [packed], device=device)
    return Band(packed, band.saturated, band.pixel_count, band.frame_count, device, (*band.owner, encoded))


@wp.func
def srgb(linear: float) -> float:
    """Return the sRGB curve of a value limited to 0…1."""
    value = wp.clamp(linear, 0.0, 1.0)
    if value <= 0.0031308:
        return 12.92 * value
    return 1.055 * wp.pow(value, 1.0 / 2.4) - 0.055


@once
def encode_kernel(pack: int) -> Any:
    """Return the kernel: one thread for a pack of one light, all three channels."""
    half_pack, load, store = pack_type(pack, wp.float16), pack_load(pack, wp.float16), pack_store(pack, wp.float16)

    @wp.kernel(enable_backward=False, module="unique")
    def encode_display(first: int,
                       values: wp.array2d(dtype=half_pack),  # [3 · L, P] stored radiance
                       gains: wp.array2d(dtype=float),  # [3, L]
                       display_from_stack: wp.mat33,
                       # outputs
                       encoded: wp.array2d(dtype=half_pack)):  # [3 · L, P] 0…1
        thread = first + wp.tid()
        packs = values.shape[1]
        light = thread / packs
        p = thread % packs
        lights = gains.shape[1]
        gain = wp.vec3(gains[0, light], gains[1, light], gains[2, light])
        red = load(values, light, p)
        green = load(values, lights + light, p)
        blue = load(values, 2 * lights + light, p)
        r, g, b = half_pack(), half_pack(), half_pack()
        for k in range(pack):
            scene = wp.cw_mul(gain, wp.vec3(float(red[k]), float(green[k]), float(blue[k])))
            shown = display_from_stack * scene
            r[k] = wp.float16(srgb(shown[0]))
            g[k] = wp.float16(srgb(shown[1]))
            b[k] = wp.float16(srgb(shown[2]))
        store(encoded, light, p, r)
        store(encoded, lights + light, p, g)
        store(encoded, 2 * lights + light, p, b)

    return encode_display
