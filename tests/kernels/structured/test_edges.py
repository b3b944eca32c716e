"""Gray code interpolated between the edges of its stripes: better than the stripes, and as uncertain as it says."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.status import Status
from kernels.structured.binary import decode_gray
from kernels.structured.edges import EDGE_ERROR, WHOLE, edge_error_of, refine_edges
from kernels.structured.pattern_frames import NoiseModel, upload
from stage.patterns.binary import binary_patterns
from stage.patterns.codes import collect
from tests.marks import first_short
from tests.scenes.patterns import NOISE, frames_of, result, view

WIDTH, ROWS, COLUMNS = 1280, 40, 300
QUIET = NoiseModel(0.001, 0.0)


def slope_of(per_pixel, rows=ROWS, columns=COLUMNS):
    """[rows, columns] places: a tilted plane, each row beginning elsewhere."""
    return 100 + 0.37 * np.arange(rows)[:, None] + per_pixel * np.arange(columns)[None, :]


def run(u, device, *, per_pixel, stripe=1, noise=QUIET, down=False, spoil=None, seen=1.0, edge_error=EDGE_ERROR):
    patterns = binary_patterns(WIDTH, "column", stripe_px=stripe)
    image = u.T if down else u
    stack = view(patterns, image.ravel(), WIDTH, noise=noise, blur=seen * abs(per_pixel), albedo=np.linspace(0.4, 0.9, image.size))
    if spoil is not None:
        spoil(stack)
    found = collect(patterns)
    code = found.codes[0]
    frames = frames_of(stack, device)
    plain = decode_gray(frames, code.frames, code.inverses, white=found.white, black=found.black, extent=WIDTH, stripe_px=stripe,
                        noise=noise)
    fine = refine_edges(plain, frames, code.frames, code.inverses, columns=image.shape[1], down=down, extent=WIDTH, stripe_px=stripe,
                        noise=noise, edge_error=edge_error)
    results = [result(decoded, image.size) for decoded in (plain, fine)]
    return [[(array.reshape(image.shape).T if down else array.reshape(image.shape)) for array in arrays] for arrays in results]


@pytest.mark.parametrize("down", [False, True])
@pytest.mark.parametrize("per_pixel, stripe", [(0.31, 1), (-0.31, 1), (0.83, 4), (0.61, 16)])
def test_edges_are_finer_than_stripes(per_pixel, stripe, down, device):
    u = slope_of(per_pixel) + (200 if per_pixel < 0 else 0)
    plain, fine = run(u, device, per_pixel=per_pixel, stripe=stripe, down=down)
    assert (fine[3] == plain[3]).all()
    refined = fine[1] < plain[1]
    inner = (fine[3] == Status.OK)[:, 60:-60]
    assert refined[:, 60:-60][inner].mean() > 0.95
    error = (fine[0] - u)[refined]
    assert error.std() < 0.25 * (plain[0] - u)[refined].std()
    assert np.abs(error).max() < 0.6 * stripe
    z = error / fine[1][refined]
    assert 0.75 < z.std() < 1.2  # what interpolation misses is the same at both edges or not, as their places among the pixels have it


@first_short("seen", [0.0, 0.3, 0.6, 0.9, 1.3, 2.0])
@first_short("per_pixel", [0.31, 0.83])
def test_sigma_holds_edges_that_pass_between_pixels_unseen(per_pixel, seen, device):
    """Pixels see a part of the distance between them, in the limit points, as in images that are shrunk without a filter: to WHOLE of it
    both pixels of an edge see one stripe alone where it passes between these parts."""
    u = slope_of(per_pixel, rows=200)
    plain, fine = run(u, device, per_pixel=per_pixel, stripe=4, seen=seen, edge_error=edge_error_of(max(1 - WHOLE * seen, 0)))
    refined = (fine[1] < plain[1]) & (fine[3] == Status.OK)
    assert refined.mean() > 0.5
    z = (fine[0] - u)[refined] / fine[1][refined]
    assert z.std() < 1.2 and (np.abs(z) > 3).mean() < 0.01  # at all sizes up to that of a square pixel; blur makes errors smaller
    assert seen > 1 or z.std() > 0.75


def test_sigma_follows_the_noise(device):
    noise, per_pixel = NoiseModel(0.008, 1e-4), 0.4
    u = slope_of(per_pixel, rows=200)
    plain, fine = run(u, device, per_pixel=per_pixel, stripe=4, noise=noise)
    refined = (fine[1] < plain[1]) & (fine[3] == Status.OK)
    assert refined.mean() > 0.5
    z = (fine[0] - u)[refined] / fine[1][refined]
    assert z[np.abs(z) < 6].std() == pytest.approx(1, abs=0.2) and (np.abs(z) > 6).mean() < 0.01


def test_stripes_stay_where_edges_are_not(device):
    u = slope_of(0.31)
    u[:, 150:] += 57  # a step of the surface: stripes that are no neighbours

    def hole(stack):
        stack.reshape(len(stack), ROWS, COLUMNS)[:, :, 200:202] = 0.05

    plain, fine = run(u, device, per_pixel=0.31, stripe=4, spoil=hole)
    assert (fine[3][:, 200:202] == Status.SHADOWED).all() and (fine[0][:, 200:202] == 0).all()
    ok = fine[3] == Status.OK
    assert np.abs(fine[0] - u)[ok].max() <= 2.3  # nothing is interpolated across
    np.testing.assert_array_equal(fine[0][:, 149:151][ok[:, 149:151]], plain[0][:, 149:151][ok[:, 149:151]])


def test_one_column_stays_as_it_is(device):
    plain, fine = run(slope_of(0.3, rows=50, columns=1), device, per_pixel=0.3)
    np.testing.assert_array_equal(fine[0], plain[0])


def test_nothing_is_nan_whatever_the_input(device):
    stack = np.random.default_rng(7).choice([np.nan, np.inf, -1, 0, 1e-7, 1], size=(8, 600)).astype(np.float32)
    frames = upload(stack, device=device)
    decoded = decode_gray(frames, [0, 1, 2], [3, 4, 5], white=6, black=7, extent=8, noise=NOISE)
    for array in refine_edges(decoded, frames, [0, 1, 2], [3, 4, 5], columns=30, down=False, extent=8, noise=NOISE):
        assert np.isfinite(array.numpy()).all()


def test_what_cannot_be_refined_is_one_sentence(device):
    frames = upload(np.zeros((8, 60), dtype=np.float32), device=device)
    other = upload(np.zeros((8, 600), dtype=np.float32), device=device)
    decoded = decode_gray(frames, [0, 1, 2], [3, 4, 5], extent=8, noise=NOISE)
    for words, call in (("60 pixels are not whole rows of 7", lambda: refine_edges(decoded, frames, [0, 1, 2], [3, 4, 5], columns=7,
                                                                                   down=False, extent=8, noise=NOISE)),
                        ("3 bits and 2 inverses", lambda: refine_edges(decoded, frames, [0, 1, 2], [3, 4], columns=6, down=False, extent=8,
                                                                       noise=NOISE)),
                        ("decode the same frames", lambda: refine_edges(decoded, other, [0, 1, 2], [3, 4, 5], columns=6, down=False,
                                                                        extent=8, noise=NOISE))):
        with pytest.raises(ArrayError, match=words):
            call()
