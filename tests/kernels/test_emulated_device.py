"""The emulated device finds the mistakes that it is for."""

import numpy as np
import pytest
import warp as wp

from kernels import device as devices
from tests.emulated_device import NAME


@pytest.fixture(autouse=True)
def only_where_it_is(device):
    if wp.get_device(device).name != "emulated":
        pytest.skip("needs --device-emulated")


@wp.kernel
def follow(first: int, values: wp.array(dtype=float), found: wp.array(dtype=float)):
    i = first + wp.tid()
    found[i] = values[i] + wp.where(i > 0, found[i - 1], 0.0)


def test_a_kernel_whose_threads_read_each_other_is_found(device):
    with pytest.raises(AssertionError, match="follow leaves depends on the order of its threads"):
        devices.launch(follow, 100, [wp.ones(100, dtype=float, device=device)], [wp.zeros(100, dtype=float, device=device)], device=device)


def test_memory_of_the_host_is_found(device):
    values = np.ones(8, np.float32)
    host = wp.array(ptr=values.ctypes.data, shape=8, dtype=float, device=device, copy=False)
    with pytest.raises(AssertionError, match=f"follow is given 32 bytes that are not in the memory of {NAME}"):
        devices.launch(follow, 8, [host], [wp.zeros(8, dtype=float, device=device)], device=device)


def test_new_memory_is_nan_and_what_is_read_is_a_copy(device):
    array = wp.empty(5, dtype=float, device=device)
    assert np.isnan(array.numpy()).all()
    array.numpy()[:] = 1
    assert np.isnan(array.numpy()).all()


@pytest.fixture
def copied(device):
    """A copy that has begun: the pinned memory, the memory on the device, and the event after it."""
    pinned, found = wp.empty(4, dtype=float, device="cpu", pinned=True), wp.empty(4, dtype=float, device=device)
    pinned.numpy()[:] = 1
    stream = wp.Stream(device)
    wp.copy(found, pinned, stream=stream)
    return pinned.numpy(), found, stream.record_event()


def test_what_is_read_before_its_copy_is_waited_for_is_nan(device, copied):
    _, found, event = copied
    assert np.isnan(found.numpy()).all()
    wp.get_stream(device).wait_event(event)
    assert (found.numpy() == 1).all()


def test_pinned_memory_that_is_written_too_early_spoils_the_copy(device, copied):
    pinned, found, event = copied
    pinned[:2] = 7
    wp.synchronize_event(event)
    pinned[:] = 9
    assert found.numpy().tolist() == [7, 7, 1, 1]


def test_a_download_is_there_when_its_event_is(device):
    pinned, values = wp.empty(3, dtype=float, device="cpu", pinned=True), wp.ones(3, dtype=float, device=device)
    wp.copy(pinned, values)
    event = wp.get_stream(device).record_event()
    assert np.isnan(pinned.numpy()).all()
    wp.synchronize_event(event)
    assert (pinned.numpy() == 1).all()
