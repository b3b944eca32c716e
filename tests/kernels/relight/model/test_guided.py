"""Frames that are corrected on a device, compared with the same correction in float64."""

import numpy as np
import pytest
import warp as wp

from kernels import device as devices
from kernels.relight.model.guided import FramesOnDevice, FrameSums, Pixels, correct_frames

COUNT, IMAGE, FRAMES, FIRST = 13, 40, 5, 2
"""Pixels of a portion and of the image; frames of the sums, of which the first two are corrected by another call."""
RNG = np.random.default_rng(5)


def twin(plain, trust, trust_beyond, least, albedo, small, sums, has_added, has_beyond):
    """Return frames and their specular part; `sums` by name, [frames, 3, n]."""
    given = sums["gloss_given"]
    ratio = np.where(given > 1e-9, sums["shown_given"] / np.where(given > 1e-9, given, 1), 1)
    mirror = (sums["gloss"] + small[:, 3:]) * ratio
    whole = albedo * sums["told"] + sums["shown"]
    added = albedo * sums["added_matt"] + sums["added_gloss"] if has_added else 0
    inside = albedo * sums["inside_matt"] + sums["inside_gloss"] if has_beyond else 0
    share = np.maximum(plain / (inside + np.maximum(whole, 0) + added), 0)
    gain = albedo * sums["matt"] + small[:, :3] + mirror - whole
    change = trust * np.where(gain < 0, gain * np.minimum(share, 1), gain)
    if has_beyond:
        shine = sums["beyond_gloss"] + sums["beyond_small"][:, 3:]
        gain = albedo * sums["beyond_matt"] + sums["beyond_small"][:, :3] + shine - inside
        change = change + np.where(gain < 0, np.maximum(trust_beyond, least) * gain * share, trust_beyond * gain)
        mirror = mirror + shine
    if has_added:
        mirror = mirror + sums["added_gloss"]
    guided = np.maximum(plain + change, np.minimum(plain, 0))
    return guided, np.clip(mirror, 0, np.maximum(guided, 0))


@pytest.mark.parametrize(("has_added", "has_beyond", "wanted"), [
    (False, False, True), (True, False, False), (False, True, False), (True, True, True)])
def test_frames_are_corrected_as_in_float64(has_added, has_beyond, wanted, device):
    """To rounding of float32: a correction is a difference of sums up to ten times as large."""
    pack = devices.pack_width(device)
    padded = -(-COUNT // pack) * pack

    def planes(*shape):
        return RNG.uniform(0.05, 1, (*shape, padded)).astype(np.float32)

    def there(values):
        return wp.array(values, dtype=wp.float32, device=device) if len(values) else wp.empty(values.shape, wp.float32, device=device)

    values, small = planes(24), planes(FRAMES - FIRST, 6)
    sums = {name: planes(FRAMES, 6 if name == "beyond_small" else 3) for name in FrameSums._fields}
    sums["gloss_given"][:, 1] = 0
    lacking = (() if has_added else ("added",)) + (() if has_beyond else ("beyond", "inside"))
    empty = [name for name in sums if lacking and name.startswith(lacking)]
    position = RNG.permutation(IMAGE)[:COUNT]
    places = np.array([6, 0, 3, 5, 1])
    frames = RNG.uniform(-0.1, 1, (7, 3, IMAGE)).astype(np.float32)
    trust, beyond = RNG.uniform(0, 1, (2, COUNT)).astype(np.float32)
    least = float(np.median(beyond))
    packed = wp.array(values.reshape(24, -1, pack), dtype=wp.types.vector(pack, wp.float32), shape=(24, padded // pack), device=device)
    made = FramesOnDevice(there(frames), wp.zeros((7 if wanted else 0, 3, IMAGE), dtype=wp.float32, device=device))
    owned = [there(plane if name not in empty else plane[:0]) for name, plane in sums.items()]
    pixels = Pixels(packed, wp.array(position, dtype=wp.int32, device=device), there(trust),
                    there(beyond if has_beyond else beyond[:0]), least)
    correct_frames(made, wp.array(places, dtype=wp.int32, device=device), FIRST, FrameSums(*owned), there(small), pixels)

    used = {name: plane[FIRST:, :, :COUNT].astype(np.float64) for name, plane in sums.items()}
    plain = frames[places[FIRST:]][:, :, position].astype(np.float64)
    expected, mirror = twin(plain, trust, beyond, least, values[3:6, :COUNT], small[:, :, :COUNT], used, has_added, has_beyond)
    found = made.radiance.numpy()
    np.testing.assert_allclose(found[places[FIRST:]][:, :, position], expected, atol=1e-5)
    if wanted:
        np.testing.assert_allclose(made.specular.numpy()[places[FIRST:]][:, :, position], mirror, atol=1e-5)
    frames[np.ix_(places[FIRST:], range(3), position)] = found[np.ix_(places[FIRST:], range(3), position)]
    np.testing.assert_array_equal(found, frames)  # nothing else is changed
