import ast
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from kernels import ahead, graphs
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


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_interrupted_launch_waits_for_its_other_pieces(error):
    """Their arrays go when the caller has the error; a piece that was not begun is not begun."""
    begun, ended = [], []

    def fails():
        while devices.worker_count() > 1 and not begun:
            time.sleep(0.001)
        raise error

    def works():
        begun.append(1)
        time.sleep(0.05)
        ended.append(1)

    with pytest.raises(error):
        devices.Recorded([SimpleNamespace(launch=launch) for launch in (fails, *[works] * 50)]).run()
    assert len(begun) == len(ended) < 50


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
        return devices.to_numpy(visits)

    with ThreadPoolExecutor(8) as pool:
        assert all((visits == 1).all() for visits in pool.map(one, range(40)))


def test_many_threads_read_and_graphs_are_captured_afterwards(device):
    """With Warp's own numpy(), the null stream, in which nothing can be captured, stays that of a GPU after some dozen reads."""
    values = wp.array(np.arange(4096), dtype=int, device=device)
    with ThreadPoolExecutor(4) as pool:
        assert all((read == np.arange(4096)).all() for read in pool.map(lambda _: devices.to_numpy(values), range(400)))
    visits = wp.zeros(4096, dtype=int, device=device)
    work = graphs.Repeated(lambda: devices.launch(count_visits, 4096, [1], [visits], device=device), device)
    work.run()
    work.run()
    assert (devices.to_numpy(visits) == 2).all()


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


def test_a_kind_of_device_has_what_its_last_bits_depend_on(device, monkeypatch):
    kind = devices.kind(device)
    monkeypatch.setattr(wp, "get_cuda_driver_version", lambda: (99, 9))
    assert wp.config.cuda_output == "cubin" and (devices.kind(device) == kind) == (device == "cpu")


def test_memory_of_a_gpu_is_kept_and_sizes_its_batches(monkeypatch):
    pools = [SimpleNamespace(is_mempool_enabled=enabled, total_memory=(140 << 30) + 5) for enabled in (True, False)]
    kept = []
    monkeypatch.setattr(wp, "get_cuda_devices", lambda: pools)
    monkeypatch.setattr(wp, "get_device", lambda name: pools[0])
    monkeypatch.setattr(wp, "set_mempool_release_threshold", lambda *given: kept.append(given))
    devices._start.__wrapped__()
    assert kept == [(pools[0], 1.0)]
    assert devices.batch_bytes("cuda:0", 256 << 20) == 8 << 30 and devices.batch_bytes("cpu", 256 << 20) == 256 << 20
    pools[0].total_memory = 288 << 30
    assert devices.batch_bytes("cuda:0", 256 << 20) == devices.MOST_BATCH_BYTES
    pools[0].total_memory = 3 << 30
    assert devices.batch_bytes("cuda:0", 256 << 20) == 256 << 20


@pytest.mark.parametrize("driver, outdated", [(None, False), ((12, 9), True), ((13, 0), False), ((14, 1), False)])
def test_a_driver_that_is_too_old_is_said(driver, outdated, monkeypatch):
    monkeypatch.setattr(wp, "get_cuda_driver_version", lambda: driver)
    monkeypatch.setattr(wp, "get_cuda_toolkit_version", lambda: (13, 4))
    assert (devices.outdated_driver() is not None) == outdated
    with pytest.raises(DeviceError) as refused:
        devices.resolve("cuda:99")
    assert ("supports CUDA 12.9, and Warp needs CUDA 13.0" in str(refused.value)) == outdated


@pytest.mark.long
def test_a_kernel_is_loaded_from_those_made_ahead(tmp_path):
    """Warp compiles a file ahead for the CPU, under the name that it has with CUDA's blocks, and it is loaded as CUDA loads a cubin:
    another process finds it by its name and compiles nothing."""
    code = f"""
import sys
import warp as wp
from kernels import ahead, device
device.names()
kernel = ahead.every_kernel()["surface.nearest._nearest"]()
if sys.argv[1:]:
    wp.compile_aot_module(device.cuda_module(kernel), "cpu", module_dir={str(tmp_path / "made")!r})
else:
    device.load_for_cuda(kernel, "cpu")
"""
    for number, given in enumerate((["make"], [])):
        environment = os.environ | {"RELIT_KERNELS": str(tmp_path / "made"), "WARP_CACHE_PATH": str(tmp_path / f"cache {number}")}
        subprocess.run([sys.executable, "-c", code, *given], cwd=Path(devices.__file__).parents[1], check=True, env=environment)
    assert [path.name for path in (tmp_path / "made").glob("*.o")]
    assert not [path for path in (tmp_path / "cache 1").rglob("*") if path.is_file()]


def test_kernels_that_nobody_made_are_compiled_with_their_package_side_by_side(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(devices, "MADE_AHEAD", tmp_path)
    monkeypatch.setattr(wp, "load_aot_module", lambda module, device, module_dir, use_ptx: asked.append(module_dir) or missing())
    monkeypatch.setattr(wp, "force_load", lambda device, modules, **options: asked.append((device, modules, options)))

    def missing():
        raise FileNotFoundError

    smooth = ahead.every_kernel()["surface.multigrid._smooth_from_zero"]()
    devices.load_for_cuda.__wrapped__(smooth, "cuda:0")
    *looked, (device, modules, options) = asked
    assert looked == [tmp_path, None] and device == "cuda:0"
    assert options == {"block_dim": devices.CUDA_BLOCK, "max_workers": devices.worker_count()}
    package = {make().module for name, make in ahead.every_kernel().items() if name.startswith("surface.")}
    assert modules[0] is smooth.module and len(modules) == len(package) and set(modules) == package


def test_an_architecture_that_nobody_compiles_for_is_refused(tmp_path):
    with pytest.raises(DeviceError, match="architecture 12 is not one that Warp"):
        ahead.build(tmp_path / "made", [12])
    assert not (tmp_path / "made").exists()


@pytest.mark.long
def test_starting_says_nothing():
    """A machine without a GPU is an ordinary one: no line about a missing driver, on either stream."""
    done = subprocess.run([sys.executable, "-c", "from kernels import device; device.names()"], capture_output=True, text=True,
                          cwd=Path(__file__).parents[2])
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_kernels_that_are_made_when_they_are_needed_are_made_under_one_lock():
    """Warp parses a kernel as it is made, and CPython 3.11 fails where two threads parse: `kernels.device.once` lets one of them."""
    made, alone = 0, []
    for path in Path(devices.__file__).parent.rglob("*.py"):
        for function in ast.parse(path.read_text(encoding="utf-8")).body:
            inner = [each for each in ast.walk(function) if isinstance(each, (ast.FunctionDef, ast.ClassDef)) and each is not function]
            if isinstance(function, ast.FunctionDef) and any(
                    ast.unparse(decorator).startswith(("wp.kernel", "wp.func", "wp.struct"))
                    for each in inner for decorator in each.decorator_list):
                made += 1
                if [ast.unparse(each) for each in function.decorator_list] not in (["once"], ["devices.once"]):
                    alone.append(f"{path.name}: {function.name}")
    assert made > 50 and not alone
