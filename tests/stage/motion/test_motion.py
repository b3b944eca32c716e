"""Tracking frames, the flow between them, and images at positions between pixels."""

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.errors import ManifestError
from stage.motion.flow import Flow, display, extrapolate, find_flow, white_level
from stage.motion.resample import bicubic, positions, touched
from stage.motion.tracking import Interval, intervals, tracking_frames
from tests.scenes.moving import Subject, write_moving

APART = 5
"""Steps of time between the two frames."""
RNG = np.random.default_rng(3)
ROWS, COLS = 9, 13
SMALL = Subject(size=16)


def frames(subject: Subject, noise: float = 0.0, flash: float = 1.0) -> list[np.ndarray]:
    """The two frames as flow sees them."""
    rng = np.random.default_rng(1)
    found = []
    for time, strength in ((0, 1.0), (APART, flash)):
        image = strength * subject.full(time) + rng.normal(0, noise, (subject.size, subject.size, 3))
        radiance = image.astype(np.float32)
        found.append(display(radiance, white_level(radiance, subject.mask(0))))
    return found


@pytest.mark.parametrize(("subject", "median_px", "p95_px"), [
    # of the search: patches of 8 pixels and a smoothness that pulls in the ground at the rim, where the larger errors lie
    (Subject(shift_px=(0.06, 0.09)), 0.03, 0.2),
    (Subject(shift_px=(0.43, -0.31)), 0.03, 0.2),
    (Subject(shift_px=(2.43, -1.31)), 0.03, 0.2),
    (Subject(shift_px=(0.3, 0.2), turn_degrees=0.4), 0.06, 0.3),  # and a patch is taken to shift, not to turn
    (Subject(turn_degrees=1.0), 0.1, 1.0),
], ids=["part of a pixel", "2.7 px", "14 px", "2 degrees", "5 degrees"])
def test_flow_of_a_textured_subject(subject, median_px, p95_px):
    flow = find_flow(*frames(subject))
    inside = subject.mask(0)
    error = np.linalg.norm(flow.displacement - subject.flow(0, APART), axis=-1)[inside]
    assert np.median(error) < median_px and np.percentile(error, 95) < p95_px
    assert flow.known[inside].mean() > 0.98


def test_noise_and_a_weaker_flash_are_borne():
    """Noise of 1 % of white in each channel and a flash of 80 % add little to what the search errs without them."""
    subject = Subject(shift_px=(0.43, -0.31))
    flow = find_flow(*frames(subject, noise=0.01, flash=0.8))
    error = np.linalg.norm(flow.displacement - subject.flow(0, APART), axis=-1)[subject.mask(0)]
    assert np.median(error) < 0.03


def test_a_subject_that_stands_still_has_no_flow():
    flow = find_flow(*frames(Subject()))
    assert np.abs(flow.displacement).max() < 1e-3 and flow.known.all()


def test_a_guess_carries_the_search_over_a_long_way():
    subject = Subject(shift_px=(5.3, -4.1))  # 33 px in five steps of time, on a subject 73 wide
    near, far = (display(subject.full(time).astype(np.float32), 1.0) for time in (0, APART))
    guess = subject.flow(0, 4).astype(np.float32)
    kept = guess.copy()
    inside = subject.mask(0) & (subject.flow(0, APART)[..., 0] + np.arange(subject.size) < subject.size - 8)
    inside[:32] = False
    error = np.linalg.norm(find_flow(near, far, guess).displacement - subject.flow(0, APART), axis=-1)[inside]
    assert np.median(error) < 0.03  # without the guess: 29 px
    assert np.array_equal(guess, kept)


def test_a_subject_may_turn_far_in_small_steps():
    """28 degrees in four steps: without a guess the search, which shifts patches and does not turn them, is 9 px off at 21."""
    subject = Subject(size=160, turn_degrees=1.0)
    first, inside = display(subject.full(0).astype(np.float32), 1.0), subject.mask(0)
    flow = None
    for time in (7, 14, 21, 28):
        guess = None if flow is None else extrapolate(flow, inside)
        flow = find_flow(first, display(subject.full(time).astype(np.float32), 1.0), guess)
        error = np.linalg.norm(flow.displacement - subject.flow(0, time), axis=-1)[inside]
        assert np.median(error) < 0.13 and flow.known[inside].mean() > 0.9  # 0.09 in the first step, and it stays


def test_a_guess_goes_on_beyond_what_is_known():
    displacement, mask = np.zeros((40, 60, 2), np.float32), np.zeros((40, 60), bool)
    mask[10:30, 10:30] = True
    displacement[..., 0] = np.where(mask, 3, -20)
    known = np.ones((40, 60), bool)
    displacement[20, 20], known[20, 20] = 99, False
    guess = extrapolate(Flow(displacement, known), mask)
    assert guess.dtype == np.float32 and np.allclose(guess, [3, 0], atol=1e-4)
    nothing = Flow(displacement, np.zeros((40, 60), bool))
    assert np.array_equal(extrapolate(nothing, mask), displacement)


def layers(shift: int) -> tuple[np.ndarray, np.ndarray]:
    """A textured square in front of a textured ground, and where it is."""
    ground, front = Subject().albedo(0), Subject(shift_px=(shift, 0)).albedo(1)[::-1]
    at = np.arange(96) + 0.5 - 48
    square = (np.abs(at[None] - shift) < 20) & (np.abs(at[:, None]) < 20)
    return display(np.repeat(np.where(square, front, ground)[..., None], 3, axis=-1).astype(np.float32), 1.0), square


def test_what_is_hidden_in_the_other_frame_is_not_known():
    (first, before), (second, after) = layers(0), layers(6)
    flow = find_flow(first, second)
    hidden = after & ~before
    assert (~flow.known[hidden]).mean() > 0.9
    assert (~flow.known[~hidden]).mean() < 0.05  # patches of 8 pixels at the square's outline
    error = np.linalg.norm(flow.displacement - np.where(before, 6, 0)[..., None] * [1, 0], axis=-1)
    assert (error[flow.known & ~hidden] > 1).mean() < 0.01


def test_what_leaves_the_image_is_not_known():
    ground = Subject(shift_px=(4.4, 0.0))
    first, second = (display(np.repeat(ground.albedo(time)[..., None], 3, axis=-1).astype(np.float32), 1.0) for time in (0, 1))
    known = find_flow(first, second).known
    assert not known[:, 93:].any() and known[8:-8, 8:85].mean() > 0.98  # the 4.4 px at the right edge


def test_display_values():
    grey = np.full((1, 1, 3), 0.4, np.float32)
    assert display(grey, 0.8)[0, 0] == pytest.approx(255 * (0.5 / 1.25) ** (1 / 2.2), rel=1e-5)
    assert display(grey, 0.1)[0, 0] == 255 and display(-grey, 1.0)[0, 0] == 0


def keys(distance: float) -> float:
    """Keys 1981, eq. 15."""
    d = abs(distance)
    return 1.5 * d**3 - 2.5 * d**2 + 1 if d < 1 else -0.5 * d**3 + 2.5 * d**2 - 4 * d + 2 if d < 2 else 0.0


def twin(image: np.ndarray, x: float, y: float) -> np.ndarray:
    total = np.zeros(image.shape[2])
    for r in range(int(np.floor(y)) - 1, int(np.floor(y)) + 3):
        for c in range(int(np.floor(x)) - 1, int(np.floor(x)) + 3):
            inside = np.clip(r, 0, ROWS - 1), np.clip(c, 0, COLS - 1)
            total += keys(x - c) * keys(y - r) * image[inside]
    return total


def somewhere() -> tuple[np.ndarray, np.ndarray]:
    x, y = RNG.uniform(0, COLS - 1, (ROWS, COLS)), RNG.uniform(0, ROWS - 1, (ROWS, COLS))
    x[0, :3], y[0, :3] = (0, COLS - 1, 4), (0, ROWS - 1, 4.5)  # corners, and a whole number of pixels
    return x.astype(np.float32), y.astype(np.float32)


def test_bicubic_is_the_kernel_of_keys():
    image, (x, y) = RNG.uniform(0, 5, (ROWS, COLS, 3)).astype(np.float32), somewhere()
    expected = [[twin(image.astype(np.float64), float(x[r, c]), float(y[r, c])) for c in range(COLS)] for r in range(ROWS)]
    assert np.allclose(bicubic(image, x, y), expected, atol=2e-5)  # float32: 2^-24 of values and second differences up to 20


def test_at_whole_pixels_nothing_is_resampled():
    image = RNG.normal(0, 1, (ROWS, COLS, 3)).astype(np.float32)
    x, y, inside = positions(np.zeros((ROWS, COLS, 2), np.float32))
    assert inside.all() and np.array_equal(bicubic(image, x, y), image)


def test_positions_outside_are_told_and_brought_to_the_edge():
    displacement = np.zeros((3, 4, 2), np.float32)
    displacement[1] = [[-0.01, 0], [2.5, 0], [0, -1.5], [0, 1]]
    x, y, inside = positions(displacement)
    assert inside[1].tolist() == [False, False, False, True] and inside[[0, 2]].all()
    assert x[1].tolist() == [0, 3, 2, 3] and y[1].tolist() == [1, 1, 0, 2]


@pytest.mark.parametrize("share", [0.0, 0.05, 1.0])
def test_every_reading_that_a_flagged_pixel_takes_part_in_is_flagged(share):
    flags, (x, y) = RNG.random((ROWS, COLS)) < share, somewhere()
    found = touched(flags, x, y)
    for r in range(ROWS):
        for c in range(COLS):
            i, j = int(y[r, c]), int(x[r, c])
            assert found[r, c] == flags[max(i - 1, 0) : i + 3, max(j - 1, 0) : j + 3].any()


def opened(folder, order):
    return Capture.open(write_moving(folder, SMALL, order))


@pytest.mark.parametrize(("order", "times", "reference"), [
    ("TLLLT", (0, 4), 1), ("TLTLT", (0, 2, 4), 1), ("LTLTLTLT", (1, 3, 5, 7), 2),
])
def test_the_middle_tracking_frame_is_the_reference(tmp_path, order, times, reference):
    found = tracking_frames(opened(tmp_path, order))
    assert (found.times, found.reference) == (times, reference)
    assert [frame.image for frame in found.frames] == [f"{time:02d}.exr" for time in times]


def test_another_may_be_named(tmp_path):
    capture = opened(tmp_path, "TLTLT")
    assert tracking_frames(capture, to="04.exr").reference == 2
    with pytest.raises(ManifestError, match=r"frame: --align-to takes one of 00\.exr, 02\.exr, 04\.exr$"):
        tracking_frames(capture, to="01.exr")


@pytest.mark.parametrize(("order", "count"), [("LLLL", 0), ("LLTLL", 1)])
def test_two_are_needed(tmp_path, order, count):
    with pytest.raises(ManifestError, match=f"{count} lit by a full light: --align follows the subject"):
        tracking_frames(opened(tmp_path, order))


def test_an_image_too_small_to_be_followed(tmp_path):
    capture = Capture.open(write_moving(tmp_path, Subject(size=15), "TLT"))
    with pytest.raises(ManifestError, match=r"camera\.resolution: is 15x15: --align needs 16 to 32766"):
        tracking_frames(capture)


def test_intervals_go_outward_from_the_reference(tmp_path):
    capture = opened(tmp_path, "LTLLLTLTLLTL")
    found = intervals(capture, tracking_frames(capture, to="05.exr"), capture.sources())
    third, fourth = pytest.approx(1 / 3), pytest.approx(4 / 3)
    assert found == [Interval(1, (4,), (0.5,)), Interval(2, (5, 6, 7), (third, pytest.approx(2 / 3), fourth)),
                     Interval(0, (0, 1, 2, 3), (-0.25, 0.25, 0.5, 0.75))]


@pytest.mark.parametrize(("order", "words"), [
    ("LLLTLT", r"frames\[0\]: lies more than one tracking interval before the"),
    ("TLTLLL", r"frames\[5\]: lies more than one tracking interval after the"),
])
def test_a_frame_far_outside_is_named(tmp_path, order, words):
    capture = opened(tmp_path, order)
    with pytest.raises(ManifestError, match=words):
        intervals(capture, tracking_frames(capture), capture.sources())
    capture = opened(tmp_path / "near", order.replace("LLL", "LL"))
    intervals(capture, tracking_frames(capture), capture.sources())  # exactly one interval is not too far
