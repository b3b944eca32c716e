"""Direct and global light from sinusoids: the paper's equations inverted, bounced light, noise, saturation, and what is refused."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.status import Status
from kernels.structured.pattern_frames import saturated_bits, upload
from kernels.structured.separation import separate
from stage.patterns.phase import phase_patterns
from tests.scenes.patterns import frames_of, places, view

WIDTH = 1024
SHIFTS = (0.0, 0.25, 0.5, 0.75)


def lit(direct, indirect, phase, shifts, *, leak=0.0, ambient=0.0):
    """[frames, pixels] float64: the paper's model, a projector's level p giving leak + (1 - leak) p of its white."""
    level = (1 + np.cos(phase - 2 * np.pi * np.array(shifts)[:, None])) / 2
    shown, mean = leak + (1 - leak) * level, leak + (1 - leak) / 2
    return ambient + direct * shown + indirect * mean


def scene(count=1000, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 0.6, count), rng.uniform(0, 0.3, count), rng.uniform(0, 2 * np.pi, count)


@pytest.mark.parametrize("shifts", [SHIFTS, (0, 1 / 3, 2 / 3), (0.1, 0.15, 0.4, 0.7, 0.72)], ids=["four", "three", "uneven"])
@pytest.mark.parametrize("leak", [0.0, 0.05])
def test_the_model_is_inverted(shifts, leak, device):
    direct, indirect, phase = scene()
    frames = frames_of(lit(direct, indirect, phase, shifts, leak=leak), device)
    parts = separate(frames, range(len(shifts)), shifts, period_px=8, leak=leak)
    np.testing.assert_allclose(parts.direct.numpy()[0, :1000], direct, atol=2e-5)  # float32, and the spread of uneven shifts
    np.testing.assert_allclose(parts.indirect.numpy()[0, :1000], indirect, atol=2e-5)
    assert (parts.status.numpy()[:1000] == Status.OK).all()


def test_a_black_frame_takes_off_the_ambient_light_and_the_projectors_black(device):
    direct, indirect, phase = scene()
    black = 0.2 + 0.05 * (direct + indirect)
    stack = np.concatenate([lit(direct, indirect, phase, SHIFTS, leak=0.05, ambient=0.2), black[None]])
    parts = separate(frames_of(stack, device), range(4), SHIFTS, period_px=8, black=4)
    np.testing.assert_allclose(parts.direct.numpy()[0, :1000], 0.95 * direct, atol=2e-6)
    np.testing.assert_allclose(parts.indirect.numpy()[0, :1000], 0.95 * indirect, atol=2e-6)


def test_channels_are_separated_each(device):
    colours = [scene(seed=seed)[:2] for seed in range(3)]
    phase = scene()[2]
    stack = np.stack([lit(direct, indirect, phase, SHIFTS) for direct, indirect in colours], axis=1)
    parts = separate(frames_of(stack, device), range(4), SHIFTS, period_px=8)
    for channel, (direct, indirect) in enumerate(colours):
        np.testing.assert_allclose(parts.direct.numpy()[channel, :1000], direct, atol=2e-6)
        np.testing.assert_allclose(parts.indirect.numpy()[channel, :1000], indirect, atol=2e-6)


def test_light_over_a_facing_surface_is_global(device):
    """A synthetic scene whose bounced light is spread over 60 columns: under 12 it is all but even."""
    u = WIDTH / 4 + places(3000, WIDTH / 2)  # away from the border, where the spread pattern is not even
    stack = view(phase_patterns("column", (12.0,), 4), u, WIDTH, albedo=0.5, ambient=0.0, bounce=0.5)
    parts = separate(frames_of(stack, device), range(4), SHIFTS, period_px=12)
    np.testing.assert_allclose(parts.direct.numpy()[0, :3000], 0.5, rtol=2e-3)
    np.testing.assert_allclose(parts.indirect.numpy()[0, :3000], 0.25, rtol=1e-2)  # what the spread leaves of the pattern


def test_without_direct_light_its_part_is_that_of_the_noise(device):
    count, sigma = 20000, 0.004
    stack = 0.15 + np.random.default_rng(1).normal(0, sigma, (4, count))
    parts = separate(frames_of(stack, device), range(4), SHIFTS, period_px=8)
    assert parts.direct.numpy()[0, :count].mean() == pytest.approx(2 * sigma * np.sqrt(np.pi / 4), rel=0.02)
    assert (parts.status.numpy()[:count] == Status.OK).all()


def test_saturated_pixels_say_so_and_other_frames_do_not_matter(device):
    direct, indirect, phase = scene(8)
    stack = np.concatenate([lit(direct, indirect, phase, SHIFTS), np.ones((1, 8))])
    saturated = np.zeros((5, 8), dtype=bool)
    saturated[2, 3] = saturated[4] = True
    parts = separate(upload(stack.astype(np.float32), saturated_bits(saturated), device=device), range(4), SHIFTS, period_px=8)
    assert parts.status.numpy()[:8].tolist() == [Status.SATURATED if pixel == 3 else Status.OK for pixel in range(8)]
    assert parts.direct.numpy()[0, 3] == parts.indirect.numpy()[0, 3] == 0


@pytest.mark.parametrize("numbers, shifts, options, words", [
    ([0, 1], [0, 0.5], {}, "give three or more different ones"),
    ([0, 1, 2], [0, 0.5, 0.5], {}, "give three or more different ones"),
    ([0, 1, 2], [0, 0.5], {}, "there are 3 frames and 2 shifts"),
    ([0, 1, 9], [0, 0.3, 0.6], {}, "frame 9 does not exist"),
    ([0, 1, 2], [0, 0.3, 0.6], {"black": 2}, "frame 2 is given for two patterns"),
    ([0, 1, 2], [0, 0.3, 0.6], {"leak": 1.0}, "the leak is 1"),
    ([0, 1, 2], [0, 0.3, 0.6], {"leak": 0.1, "black": 3}, "beside a black frame"),
])
def test_what_cannot_be_separated_is_one_sentence(numbers, shifts, options, words, device):
    with pytest.raises(ArrayError, match=words):
        separate(upload(np.zeros((4, 4), dtype=np.float32), device=device), numbers, shifts, period_px=8, **options)
