"""Reduce a capture to a few coefficient images: for a browser (svd), or for viewers of relightable images (ptm, lrgb-ptm, hsh).

The first K singular vectors of each channel give the sum of K images with the least squared error. Polynomial texture maps and
hemispherical harmonics are fitted to display values as a viewer shows them, twice: once for the ranges of the coefficients and once to be
stored, so that only bytes are kept of the whole image.

Source: Eckart and Young, "The approximation of one matrix by another of lower rank", Psychometrika 1, 1936 (kernels.relight.basis.basis);
Malzbender, Gelb and Wolters, "Polynomial texture maps", SIGGRAPH 2001, section 3; Gautron et al., "A novel hemispherical basis for
accurate and efficient rendering", Eurographics Symposium on Rendering 2004 (kernels.relight.basis.rti has the equations).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels import device as devices
from kernels.device import to_numpy
from kernels.errors import ArrayError
from kernels.packs import Band
from kernels.relight.basis.basis import Basis, gram, principal, projection, squared_residual
from kernels.relight.basis.rti import HSH_TERMS, PTM_TERMS, WHITE, biquadratic, fit_weights, hemispherical_harmonics, separate
from kernels.relight.frames.combine import combine_batch
from service.basis.capture import WHITE_PERCENTILE, BasisCapture, BasisResult, Display, display_of, open_capture, stack_bands, stored_sample
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.requests.basis import BasisKind, BasisRequest
from service.viewing.light_transfer import KEY_LIGHTS, key_weights
from stage.errors import ManifestError
from stage.formats.rti import Hsh, Ptm, Quantization, dequantize, quantization_of_range, quantize, write_hsh, write_ptm
from stage.results.light_basis import layer_name, layer_types, numbers, write_facts, write_layers
from stage.stack.stack_file import TOP_EXPONENT
from stage.transforms import fibonacci_sphere

SUFFIXES = {BasisKind.SVD: ".exr", BasisKind.PTM: ".ptm", BasisKind.LRGB_PTM: ".ptm", BasisKind.HSH: ".rti"}
"""The suffix of each kind's file; where no kind is named, the first one with the suffix is made."""
PROBES, FAR_DEGREES, LEAST_FAR = 2000, 30.0, 0.1
"""Directions over the sphere that are tried, and angle from every light and part of the hemisphere from which extrapolation is said: domes
whose lamps end 20° above the horizon leave none; of a cone of 41° a viewer shows the rest off by 45 to 51 of 255 (root mean square)."""
DEFAULT_COUNT = 16
LIGHTS_PER_TERM = 2
"""Least lights for each term of hemispherical harmonics where no count is given: with fewer, values oscillate between the lights."""


def make_basis(request: BasisRequest, progress: Progress | None = None) -> BasisResult:
    """Reduce a capture to a basis and write it, whole or not at all.
    Raises RequestError if a suffix or a count that the kind does not have, or a result that would replace an input."""
    kind = resolve_kind(request.kind, request.out)
    device = devices.resolve(request.device)
    timings = Timings(progress)
    source = open_capture(request, timings)
    if kind == BasisKind.SVD:
        return make_svd(request, source, device, timings)
    return make_rti(request, kind, source, device, timings)


def resolve_kind(kind: BasisKind | None, out: Path) -> BasisKind:
    """Return the kind that is asked for, by name or by the suffix of the file, which must be that of the kind."""
    suffix = out.suffix.lower()
    if kind is None:
        kind = next((k for k, s in SUFFIXES.items() if s == suffix), None)
        if kind is None:
            raise RequestError(f"--out {out}: end the name in .exr (coefficient images), .ptm (polynomial texture map) or .rti "
                               "(hemispherical harmonics)")
    elif suffix != SUFFIXES[kind]:
        raise RequestError(f"--out {out}: end the name in {SUFFIXES[kind]} for --kind {kind}")
    return kind


def make_svd(request: BasisRequest, source: BasisCapture, device: str, timings: Timings) -> BasisResult:
    """Write coefficient images as an EXR, and matrices and errors as JSON beside it."""
    stack, lights = source.stack, source.stack.light_count
    count = min(DEFAULT_COUNT, lights) if request.count is None else request.count
    if count > lights:
        raise RequestError(f"--count {count}: {source.where} has {lights} lights: give 1 to {lights}")
    scale = stack.scale[:lights].astype(np.float64)
    products = np.zeros((3, lights, lights))
    for each in stack_bands(source, device, 0, timings, "products"):
        products += gram(each.band, each.inside)[:, :lights, :lights]
    products *= scale[:, None] * scale  # from stored values to radiance
    basis = principal(products, count)
    rms = basis.singular_values[:, :count].T / np.sqrt(source.pixels)
    bound = float(np.linalg.norm(2.0**TOP_EXPONENT * scale))  # no pixel's radiance over all lights, nor any coefficient, is larger
    layers = [np.zeros((3, stack.pixel_count), dtype=dtype) for dtype in layer_types(rms, bound)]
    weights = projection(basis, stack.scale)
    gains = np.broadcast_to(stack.scale, (3, stack.shape[1]))
    functions = np.zeros((3, stack.shape[1], count))
    functions[:, :lights] = np.swapaxes(basis.matrix, 1, 2)
    left = np.zeros(3)
    for each in stack_bands(source, device, 3 * 12 * count, timings, "layers"):
        coefficients = to_numpy(combine_batch(each.band, weights))
        width = each.span.stop - each.span.start
        for k, layer in enumerate(layers):
            layer[:, each.span] = np.where(each.inside, coefficients[k], 0)[:, :width]
            coefficients[k, :, :width] = layer[:, each.span]  # rounded as it is stored: what is left is what the file leaves
        squares = to_numpy(squared_residual(each.band, gains, coefficients, functions))
        left += squares[:, each.inside].sum(axis=1, dtype=np.float64)
    timings.stage("write", source.capture.camera.height)
    rows, cols = source.capture.camera.height, source.capture.camera.width
    whole = np.trace(products, axis1=1, axis2=2)
    write_layers(request.out, [layer.reshape(3, rows, cols) for layer in layers],
                 source.inside[: stack.pixel_count].reshape(rows, cols), color_space=source.space, metadata=source.provenance,
                 progress=timings.advance)
    tail = (basis.singular_values[:, count:] ** 2).sum()
    relative = _relative(left.sum(), whole.sum())
    key_lights = _key_light_error(source, basis, products)
    facts = write_facts(request.out, {
        "kind": BasisKind.SVD, "capture": source.capture.name, "image": request.out.name, "resolution": [cols, rows], "count": count,
        "layers": [layer_name(k) for k in range(count)], "color_space": source.space,
        "lights": source.described_lights(np.arange(lights)),
        "convention": "frame[c] = sum over k of (sum over l of matrix[c][k][l] * weight[c][l]) * layers[k][c]",
        "matrix": numbers(basis.matrix),
        "singular_values": numbers(basis.singular_values),
        "error": {"relative_rms": numbers(relative),
                  "relative_rms_rgb": numbers([_relative(*pair) for pair in zip(left, whole, strict=True)]),
                  "truncation": numbers(_relative(tail, whole.sum())), "truncation_rgb": numbers(basis.truncation),
                  "key_lights": KEY_LIGHTS, "key_lights_relative_rms": None if key_lights is None else numbers(key_lights),
                  "pixels": source.pixels},
        "warnings": source.warnings, "provenance": source.provenance,
    })
    timings.close()
    return BasisResult(request.out, facts, BasisKind.SVD, count, source.pixels, lights, 0, source.near, relative, None, source.warnings,
                       key_lights)


def _key_light_error(source: BasisCapture, basis: Basis, products: np.ndarray) -> float | None:
    """Return the relative error of pictures under key lights from between the captured lights, root mean square over the lights; None: a
    captured light gives nothing in a channel, so that no other light can be shared out over them.

    A picture of weights w has the squared norm wᵀ G w with the Gram matrix G of the images, and the basis leaves wᵀ P G P w of it, where P
    projects on what it lacks.
    """
    try:
        weights = key_weights(source.lights).astype(np.float64)
    except ArrayError:
        return None
    lacks = np.eye(products.shape[1]) - np.einsum("ckl,ckm->clm", basis.matrix, basis.matrix)
    lacking = np.einsum("clm,ncm->ncl", lacks, weights)
    left = np.einsum("ncl,clm,ncm->n", lacking, products, lacking, optimize=True)
    whole = np.einsum("ncl,clm,ncm->n", weights, products, weights, optimize=True)
    return float(np.sqrt(np.mean(np.maximum(left, 0) / np.where(whole > 0, whole, 1))))


def _relative(left: float, whole: float) -> float:
    return float(np.sqrt(left / whole)) if whole > 0 else 0.0


def extrapolation_sentences(directions: np.ndarray) -> list[str]:
    """Return a sentence if a viewer offers light far from all lights [lights, 3] unit, where the functions are extrapolated."""
    offered = fibonacci_sphere(PROBES)
    offered = offered[offered[:, 2] > 0]
    apart = np.degrees(np.arccos(np.clip((offered @ directions.T).max(axis=1), -1, 1)))
    far = float(np.mean(apart > FAR_DEGREES))
    if far < LEAST_FAR:
        return []
    return [f"frames[].light.direction: {100 * far:.0f} % of the directions that a viewer offers are more than {FAR_DEGREES:.0f}° from "
            "every light: what it shows there is extrapolated and mostly wrong, and the stated error does not count it; light from there "
            "has to be captured"]


class Model(NamedTuple):
    """The functions that are fitted, and the display values that they are fitted to."""

    kind: BasisKind
    display: Display
    functions: np.ndarray  # [lights padded, terms], display value = Σ function · coefficient; 0 for lights left out
    weights: np.ndarray  # [terms, 3, lights padded] float32, coefficient = Σ weight · display value

    @property
    def terms(self) -> int:
        """The number of coefficients of each channel."""
        return int(self.functions.shape[1])

    def fit(self, shown: Band) -> tuple[np.ndarray, np.ndarray | None]:
        """Return coefficients [terms, 3 or 1, pixels padded] float32, and for a luminance its colour [3, pixels padded] uint8."""
        fitted = to_numpy(combine_batch(shown, self.weights))
        if self.kind != BasisKind.LRGB_PTM:
            return fitted, None
        luminance = separate(fitted, self.functions[self.display.front] * WHITE)
        return luminance.coefficients[:, None], luminance.colour

    def squared_difference(self, shown: Band, coefficients: np.ndarray, colour: np.ndarray | None, inside: np.ndarray) -> float:
        """Return Σ (what a viewer shows − display value)² over channels, lights and the pixels inside."""
        in_colour = coefficients if colour is None else coefficients * (colour / np.float32(WHITE))
        functions = np.broadcast_to(self.functions, (3, *self.functions.shape))
        squares = to_numpy(squared_residual(shown, (self.display.gains > 0).astype(np.float32), in_colour, functions, low=0.0, high=1.0))
        return float(squares[:, inside].sum(dtype=np.float64))


def make_rti(request: BasisRequest, kind: BasisKind, source: BasisCapture, device: str, timings: Timings) -> BasisResult:
    """Write a `.ptm` or `.rti` file, and exposure, lights and errors as JSON beside it."""
    model, stack = _model(request, kind, source), source.stack
    source = source._replace(warnings=(*source.warnings, *extrapolation_sentences(source.lights.direction[model.display.front])))
    terms, pixels = model.terms, stack.pixel_count
    bytes_per_pixel = (6 + 4) * stack.shape[1] + 8 * 12 * terms  # display values, luminances, and coefficients in their stages
    low, high = np.zeros(terms), np.zeros(terms)
    for each in stack_bands(source, device, bytes_per_pixel, timings, "fit"):
        inside = model.fit(model.display.shown(each.band))[0][:, :, each.inside]
        low, high = np.minimum(low, inside.min(axis=(1, 2))), np.maximum(high, inside.max(axis=(1, 2)))
    quantization = quantization_of_range(low, high)
    channels = 1 if kind == BasisKind.LRGB_PTM else 3
    stored = np.tile(quantization.zero.astype(np.uint8), (channels, pixels, 1))
    colours = np.zeros((pixels, 3), dtype=np.uint8)
    loss = np.zeros(3)  # as fitted, as stored, and without anything
    for each in stack_bands(source, device, bytes_per_pixel, timings, "store"):
        shown = model.display.shown(each.band)
        fitted, colour = model.fit(shown)
        levels = quantize(np.where(each.inside, fitted, 0), quantization)
        width = each.span.stop - each.span.start
        stored[:, each.span] = np.moveaxis(levels, 0, -1)[:, :width]
        if colour is not None:
            colours[each.span] = np.where(each.inside, colour, 0).T[:width]
        loss += [model.squared_difference(shown, coefficients, colour, each.inside)
                 for coefficients in (fitted, dequantize(levels, quantization), np.zeros_like(fitted))]
    timings.stage("write", 1)
    rows, cols = source.capture.camera.height, source.capture.camera.width
    grid = stored.reshape(channels, rows, cols, terms)
    if kind == BasisKind.HSH:
        write_hsh(request.out, Hsh(grid, quantization))
    else:
        write_ptm(request.out, Ptm(grid, quantization, colours.reshape(rows, cols, 3) if channels == 1 else None))
    lights = len(model.display.front)
    readings = 3 * source.pixels * lights
    error = {"relative_rms": np.sqrt(loss[1] / loss[2]), "levels_rms": WHITE * np.sqrt(loss[1] / readings),
             "fit_relative_rms": np.sqrt(loss[0] / loss[2])}
    facts = _write_facts(request, source, model, quantization, {name: numbers(value) for name, value in error.items()})
    timings.close()
    return BasisResult(request.out, facts, kind, terms, source.pixels, lights, stack.light_count - lights, source.near,
                        float(error["relative_rms"]), float(error["levels_rms"]), source.warnings, None)


def _model(request: BasisRequest, kind: BasisKind, source: BasisCapture) -> Model:
    directions = source.lights.direction
    front = np.flatnonzero(directions[:, 2] > 0)
    terms = _terms(request.count, kind, len(front))
    if len(front) < terms:
        others = len(directions) - len(front)
        raise ManifestError(f"{source.where}: frames: {len(front)} are lit from in front of the object (z > 0; {others} others are left "
                            f"out): {terms} coefficients of {kind} need {terms} or more")
    functions = hemispherical_harmonics(directions[front], terms) if kind == BasisKind.HSH else biquadratic(directions[front])
    try:
        fit = fit_weights(functions)
    except ArrayError as error:
        raise ManifestError(f"{source.where}: frames[].light.direction: {error}") from error
    lights = source.stack.shape[1]
    white = 1.0 if kind == BasisKind.HSH else WHITE
    weights, padded = np.zeros((terms, 3, lights), dtype=np.float32), np.zeros((lights, terms))
    weights[:, :, front] = white * fit[:, None]
    padded[front] = functions / white
    return Model(kind, display_of(source, front, stored_sample(source, front), kind), padded, weights)


def _terms(count: int | None, kind: BasisKind, lights: int) -> int:
    if kind != BasisKind.HSH:
        if count not in (None, PTM_TERMS):
            raise RequestError(f"--count {count}: a polynomial texture map has six coefficients: leave --count out")
        return PTM_TERMS
    if count is None:
        return 9 if lights >= LIGHTS_PER_TERM * 9 else 4
    if count not in HSH_TERMS:
        raise RequestError(f"--count {count}: hemispherical harmonics have 4, 9 or 16 coefficients")
    return count


def _write_facts(request: BasisRequest, source: BasisCapture, model: Model, quantization: Quantization, error: dict[str, float]) -> Path:
    camera = source.capture.camera
    behind = np.setdiff1d(np.arange(source.stack.light_count), model.display.front)
    return write_facts(request.out, {
        "kind": model.kind, "capture": source.capture.name, "image": request.out.name, "resolution": [camera.width, camera.height],
        "count": model.terms, "color_space": "srgb_texture",
        "convention": f"display values, as under one white light of irradiance 1 times exposure; percentile {WHITE_PERCENTILE} is white",
        "exposure": numbers(model.display.exposure), "step": numbers(quantization.step), "zero": quantization.zero.tolist(),
        "lights": source.described_lights(model.display.front), "lights_left_out": [source.stack.frames[i] for i in behind],
        "error": {**error, "pixels": source.pixels}, "warnings": source.warnings, "provenance": source.provenance,
    })
