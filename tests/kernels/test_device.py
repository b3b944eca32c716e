import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError, DeviceError


@wp.kernel(enable_backward=False)
def count_visits(
    first: int,
    step: int,
    # outputs
    visits: wp.array(dtype=int),
):
    i = first + wp.tid()
    visits[i] = visits[i] + step


@pytest.mark.parametrize("count", [0, 1, 7, 1000])
def test_a_launch_visits_every_index_once(count, device):
    visits = wp.zeros(count + 3, dtype=int, device=device)
    devices.launch(count_visits, count, [2], [visits], device=device)
    np.testing.assert_array_equal(visits.numpy(), [2] * count + [0] * 3)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="needs cores that can be chosen")
def test_on_one_core_as_on_all():
    cores = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {min(cores)})
        assert devices.worker_count() == 1
        for count in (1, 5, 257):
            visits = wp.zeros(count, dtype=int, device="cpu")
            devices.launch(count_visits, count, [1], [visits], device="cpu")
            assert (visits.numpy() == 1).all()
    finally:
        os.sched_setaffinity(0, cores)


def test_launches_from_many_threads(device):
    def one(_):
        visits = wp.zeros(500, dtype=int, device=device)
        devices.launch(count_visits, 500, [1], [visits], device=device)
        return visits.numpy()

    with ThreadPoolExecutor(8) as pool:
        assert all((visits == 1).all() for visits in pool.map(one, range(40)))


def test_a_launch_of_more_threads_than_32_bits_count_is_refused(device):
    with pytest.raises(ArrayError, match=f"the work is {2**31} threads, a launch has at most {2**31 - 1}"):
        devices.launch(count_visits, 2**31, [1], [wp.zeros(1, dtype=int, device=device)], device=device)


@pytest.mark.parametrize("name", ["cuda:99", "gpu", "", "CPU"])
def test_an_unknown_device_is_refused_with_the_known(name):
    with pytest.raises(DeviceError, match=f"device {name} is not on this machine: choose one of cpu"):
        devices.resolve(name)


def test_resolve():
    names = devices.names()
    assert names[0] == "cpu" and devices.resolve("cpu") == "cpu"
    cuda = [name for name in names if name.startswith("cuda")]
    assert devices.resolve() == (cuda[0] if cuda else "cpu")
    if cuda:
        assert devices.resolve("cuda") == "cuda:0"
    else:
        with pytest.raises(DeviceError, match="device cuda is not on this machine"):
            devices.resolve("cuda")


def test_a_device_describes_itself(device):
    assert devices.describe(device).startswith(f"{device}, ")
    assert devices.pack_width(device) == (devices.PACK_CPU if device == "cpu" else devices.PACK_CUDA)


@pytest.mark.long
def test_starting_says_nothing():
    """A machine without a GPU is an ordinary one: no line about a missing driver, on either stream."""
    done = subprocess.run([sys.executable, "-c", "from kernels import device; device.names()"], capture_output=True, text=True,
                          cwd=Path(__file__).parents[2])
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
