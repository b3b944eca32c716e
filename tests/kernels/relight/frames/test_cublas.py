"""Products of weights and the stack as cuBLAS is asked for them, done by a stand-in that reads and writes the same memory."""

import ctypes
import importlib.util
import logging

import numpy as np
import pytest

from kernels import packs
from kernels.relight.frames import cublas
from kernels.relight.frames.combine import combine_batch
from kernels.relight.frames.cublas import GROUP, SPLIT_BITS, Product, combine_by, split

LIGHTS, PIXELS = 16, 200


def memory(address: int, count: int, dtype: type) -> np.ndarray:
    """Elements at an address of the CPU."""
    return np.frombuffer((ctypes.c_char * (count * np.dtype(dtype).itemsize)).from_address(address), dtype)


def columns(address: int, rows: int, count: int, column: int, channel: int, number: int, dtype: type) -> np.ndarray:
    """[rows, count] the matrix of a channel, column by column."""
    whole = memory(address, number * channel + (count - 1) * column + rows, dtype)[number * channel :]
    return np.lib.stride_tricks.as_strided(whole, (rows, count), (whole.itemsize, column * whole.itemsize))


class StandIn:
    """cublasGemmStridedBatchedEx on halves with sums in float32, as its documentation says."""

    def __init__(self) -> None:
        self.products: list[Product] = []

    def __call__(self, p: Product) -> None:
        self.products.append(p)
        for channel in range(3):
            a = columns(p.a, p.pixels, p.lights, p.a_column, p.a_channel, channel, np.float16)
            b = columns(p.b, p.lights, p.frames, p.b_column, p.b_channel, channel, np.float16)
            c = columns(p.c, p.pixels, p.frames, p.c_column, p.c_channel, channel, np.float32)
            total = np.float32(p.alpha) * (a.astype(np.float32) @ b.astype(np.float32))
            c[:] = total if p.beta == 0 else total + np.float32(p.beta) * c  # beta 0: what was there is not read


def scene(frames: int, seed: int = 0):
    rng = np.random.default_rng(seed)
    stored = rng.random((3, LIGHTS, PIXELS)).astype(np.float16)
    weights = (rng.normal(size=(frames, 3, LIGHTS)) * 10.0 ** rng.uniform(-4, 1, (frames, 3, LIGHTS))).astype(np.float32)
    return stored, weights


@pytest.mark.parametrize("frames", [1, 31, 32, 33, 70])
def test_frames_are_those_of_float64(frames):
    stored, weights = scene(frames)
    done = StandIn()
    found = combine_by(done, packs.upload(stored, device="cpu"), weights)
    exact = np.einsum("fcl,clp->fcp", weights.astype(np.float64), stored.astype(np.float64))
    scale = np.einsum("fcl,clp->fcp", np.abs(weights).astype(np.float64), stored.astype(np.float64))
    assert found.shape[0] == frames and found.shape[2] >= PIXELS
    # sums of 16 terms in float32; split weights have 22 bits, and are exact to a 2^-35th of the largest of the frame
    limit = (LIGHTS * 2.0**-24 + 2.0**-22) * scale + np.abs(weights).max(axis=(1, 2))[:, None, None] * 2.0**-35 * LIGHTS
    assert (np.abs(found.numpy()[:, :, :PIXELS] - exact) <= limit).all()
    assert {p.frames for p in done.products} == {GROUP}


def test_frames_of_a_range_need_two_products_a_group():
    stored, weights = scene(70)
    done, scale = StandIn(), np.abs(weights).max(axis=(1, 2))
    combine_by(done, packs.upload(stored, device="cpu"), weights * (1.5 / scale)[:, None, None])
    assert len(done.products) == 2 * 3


def test_rows_that_lie_apart_in_memory():
    """A band of a mapped stack: a part of each row."""
    rng = np.random.default_rng(1)
    whole = rng.random((3, LIGHTS, 1024)).astype(np.float16)
    stored, (_, weights) = whole[:, :, 256:512], scene(5)
    band = packs.upload(stored, device="cpu")
    assert band.values.strides[0] == 2 * 1024  # not copied, so that the strides are what is tested
    exact = np.einsum("fcl,clp->fcp", weights.astype(np.float64), stored.astype(np.float64))
    assert np.abs(combine_by(StandIn(), band, weights).numpy() - exact).max() < 1e-4 * np.abs(exact).max()


def test_a_frame_does_not_depend_on_the_frames_beside_it():
    """Whether they are dark or a million times brighter."""
    stored, weights = scene(40)
    weights *= 10.0 ** np.random.default_rng(3).integers(-9, 9, 40)[:, None, None].astype(np.float32)
    band = packs.upload(stored, device="cpu")
    whole = combine_by(StandIn(), band, weights).numpy()
    for frame in range(40):
        alone = np.zeros_like(weights)
        alone[frame] = weights[frame]
        assert (combine_by(StandIn(), band, alone[: frame + 1]).numpy()[frame] == whole[frame]).all()


@pytest.mark.parametrize("largest", [1e-30, 6e-5, 1.0, 1.999, 2.0, 255.9, 1e5, 1e30])
def test_weights_of_every_size_are_split_without_loss(largest):
    rng = np.random.default_rng(2)
    weights = (largest * rng.uniform(-1, 1, (3, 3, 8))).astype(np.float32)
    weights[:, 0, 0] = largest
    (call,) = split(weights)
    assert call.first.shape == call.second.shape == (3, GROUP, 8) and call.is_first
    assert np.isfinite(call.first).all() and np.isfinite(call.second).all() and np.abs(call.first).max() <= 256
    again = np.ldexp(call.first.astype(np.float64) + np.ldexp(call.second.astype(np.float64), -SPLIT_BITS), call.exponent).swapaxes(0, 1)
    assert (np.abs(again[:3] - weights) <= 2.0**-22 * np.abs(weights) + 2.0**-35 * largest).all()
    assert not again[3:].any()


def test_black_frames_and_no_lights_at_all():
    stored, _ = scene(1)
    assert not combine_by(StandIn(), packs.upload(stored, device="cpu"), np.zeros((2, 3, LIGHTS), np.float32)).numpy().any()


def test_a_library_that_does_not_work_is_told_and_not_used(monkeypatch, caplog):
    class Broken:
        @staticmethod
        def create():
            raise RuntimeError("libcublas.so.12:\n cannot open")

    monkeypatch.setattr(cublas.importlib, "import_module", lambda name: Broken)
    monkeypatch.setattr(cublas, "is_installed", lambda: True)
    opened = cublas._open.__wrapped__
    with caplog.at_level(logging.WARNING):
        found = opened("cpu")
    assert found.gemm is None and "libcublas.so.12: cannot open" in caplog.text
    monkeypatch.setattr(cublas, "_open", lambda device: found)
    assert cublas.product_of("cuda:0") is None
    assert cublas.describe("cuda:0").startswith("does not work (libcublas.so.12: cannot open)")


def test_without_the_extra_nothing_is_imported(monkeypatch):
    monkeypatch.setattr(cublas, "is_installed", lambda: False)
    monkeypatch.setattr(cublas, "_open", lambda device: pytest.fail("opened"))
    assert cublas.product_of("cuda:0") is None and "pip install 'relit[gpu]'" in cublas.describe("cuda:0")
    assert cublas.product_of("cpu") is None


@pytest.mark.skipif(importlib.util.find_spec("nvmath") is None, reason="nvmath-python is not installed")
def test_numbers_are_those_of_the_library():
    library = importlib.import_module("nvmath.bindings.cublas")
    assert library.ComputeType.COMPUTE_32F == cublas.COMPUTE_FLOAT32
    assert (library.Operation.N, library.GemmAlgo.DEFAULT) == (cublas.NOT_TRANSPOSED, cublas.ANY_ALGORITHM)
    assert "int transb, int m, int n, int k, intptr_t alpha, intptr_t a" in \
        library.gemm_strided_batched_ex.__doc__


def test_on_cuda_both_ways_agree(device):
    if device == "cpu" or cublas.product_of(device) is None:
        pytest.skip("cuBLAS is not here")
    stored, weights = scene(40)
    band = packs.upload(stored, device=device)
    weights = np.abs(weights)
    ours = combine_batch(band, weights, with_cublas=False).numpy()[:, :, :PIXELS]
    assert np.allclose(combine_batch(band, weights).numpy()[:, :, :PIXELS], ours, rtol=cublas.TOLERANCE, atol=0)
