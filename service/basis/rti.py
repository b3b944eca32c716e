"""The captured images as a polynomial texture map or as hemispherical harmonics, fitted to display values as a viewer shows them.

Coefficients are fitted twice, once for their ranges and once to be stored, so that only bytes are kept of the whole image.

Source: Malzbender, Gelb and Wolters, "Polynomial texture maps", SIGGRAPH 2001, section 3; Gautron et al., "A novel hemispherical basis for
accurate and efficient rendering", Eurographics Symposium on Rendering 2004 (kernels.relight.basis.rti has the equations).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels.errors import ArrayError
from kernels.packs import Band
from kernels.relight.basis.basis import squared_residual
from kernels.relight.basis.rti import HSH_TERMS, PTM_TERMS, WHITE, biquadratic, fit_weights, hemispherical_harmonics, separate
from kernels.relight.frames.combine import combine_batch
from service.basis.capture import BasisCapture, BasisResult, stack_bands
from service.basis.display import WHITE_PERCENTILE, Display, display_of, stored_sample
from service.errors import RequestError
from service.reporting.progress import Timings
from service.requests.basis import BasisKind, BasisRequest
from stage.errors import ManifestError
from stage.formats.rti import Hsh, Ptm, Quantization, dequantize, quantization_of_range, quantize, write_hsh, write_ptm
from stage.results.light_basis import numbers, write_facts

LIGHTS_PER_TERM = 2
"""Least lights for each term of hemispherical harmonics where no count is given: with fewer, values oscillate between the lights."""


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
        fitted = combine_batch(shown, self.weights).numpy()
        if self.kind != BasisKind.LRGB_PTM:
            return fitted, None
        luminance = separate(fitted, self.functions[self.display.front] * WHITE)
        return luminance.coefficients[:, None], luminance.colour

    def squared_difference(self, shown: Band, coefficients: np.ndarray, colour: np.ndarray | None, inside: np.ndarray) -> float:
        """Return Σ (what a viewer shows − display value)² over channels, lights and the pixels inside."""
        in_colour = coefficients if colour is None else coefficients * (colour / np.float32(WHITE))
        functions = np.broadcast_to(self.functions, (3, *self.functions.shape))
        squares = squared_residual(shown, (self.display.gains > 0).astype(np.float32), in_colour, functions, low=0.0, high=1.0).numpy()
        return float(squares[:, inside].sum(dtype=np.float64))


def make_rti(request: BasisRequest, kind: BasisKind, source: BasisCapture, device: str, timings: Timings) -> BasisResult:
    """Write a `.ptm` or `.rti` file, and exposure, lights and errors as JSON beside it."""
    model, stack = _model(request, kind, source), source.stack
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
                        float(error["relative_rms"]), float(error["levels_rms"]), None)


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
        "error": {**error, "pixels": source.pixels}, "provenance": source.provenance,
    })
