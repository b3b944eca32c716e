"""The captured images reduced to K coefficient images by a singular value decomposition of each channel.

Source: the first K singular vectors give the sum of K images with the least squared error, Eckart and Young, "The approximation of one
matrix by another of lower rank", Psychometrika 1, 1936 (kernels.relight.basis.basis).
"""

import numpy as np

from kernels.errors import ArrayError
from kernels.relight.basis.basis import Basis, gram, principal, projection, squared_residual
from kernels.relight.frames.combine import combine_batch
from service.basis.capture import BasisCapture, BasisResult, stack_bands
from service.errors import RequestError
from service.reporting.progress import Timings
from service.requests.basis import BasisKind, BasisRequest
from service.viewing.held_out import KEY_LIGHTS, key_weights
from stage.results.light_basis import layer_name, layer_types, numbers, write_facts, write_layers
from stage.stack.stack_file import TOP_EXPONENT

DEFAULT_COUNT = 16


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
        coefficients = combine_batch(each.band, weights).numpy()
        width = each.span.stop - each.span.start
        for k, layer in enumerate(layers):
            layer[:, each.span] = np.where(each.inside, coefficients[k], 0)[:, :width]
            coefficients[k, :, :width] = layer[:, each.span]  # rounded as it is stored: what is left is what the file leaves
        squares = squared_residual(each.band, gains, coefficients, functions).numpy()
        left += squares[:, each.inside].sum(axis=1, dtype=np.float64)
    timings.stage("write", 1)
    rows, cols = source.capture.camera.height, source.capture.camera.width
    whole = np.trace(products, axis1=1, axis2=2)
    write_layers(request.out, [layer.reshape(3, rows, cols) for layer in layers],
                 source.inside[: stack.pixel_count].reshape(rows, cols), color_space=source.space, metadata=source.provenance)
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
        "provenance": source.provenance,
    })
    timings.close()
    return BasisResult(request.out, facts, BasisKind.SVD, count, source.pixels, lights, 0, source.near, relative, None, key_lights)


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
