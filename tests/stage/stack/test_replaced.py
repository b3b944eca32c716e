"""A stack with other values for some of its readings."""

import numpy as np

from stage.capture.capture import Capture
from stage.stack.ingest import open_stack
from stage.stack.stack import ReplacedStack
from tests.scenes.captures import make_scene, write_capture

SCENE = make_scene(size=12, lights=4)


def test_replaced_readings_are_the_new_ones_and_others_stay(tmp_path):
    """Also values far above the range that the image had; in bands and single pixels."""
    write_capture(tmp_path, SCENE)
    stack = open_stack(Capture.open(tmp_path))
    pixel, light = np.array([90, 20, 20]), np.array([1, 0, 3])
    new = np.float32([[40, 0.5, 0.25], [50, 0.5, 0.5], [60, 0.5, 1]])
    replaced = ReplacedStack.of(stack, pixel, light, new)
    expected = stack.band(0, stack.shape[2]).astype(float) * stack.scale[:, None]
    expected[:, light, pixel] = new
    got = replaced.band(0, stack.shape[2]).astype(float) * replaced.scale[:, None]
    np.testing.assert_allclose(got, expected, rtol=2.0**-11, atol=1e-7)  # half rounding
    chosen = np.array([90, 3, 20, 21])
    np.testing.assert_array_equal(replaced.pick(chosen)[0], replaced.band(0, stack.shape[2])[:, :, chosen])
    np.testing.assert_array_equal(replaced.band(64, 128), replaced.band(0, 192)[:, :, 64:128])
