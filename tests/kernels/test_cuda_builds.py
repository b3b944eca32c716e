"""The kernels as CUDA runs them go through the compiler that Warp brings along, on machines without a GPU too.

Kernels are discovered: every Warp kernel of a module of kernels/, and every kernel that a cached factory of a module returns. A factory's
`pack` or `lanes` is what CUDA takes; its other arguments are told by their annotations, each value in turn beside the first of the others.

What the hottest kernels take on an H100 stands in cuda_resources.txt, which `python -m tests.kernels.test_cuda_builds` writes anew: no
number there may grow but that of wide loads, which may not shrink.
"""

import importlib
import inspect
import pkgutil
import re
import tempfile
from collections.abc import Iterator
from functools import _lru_cache_wrapper, partial
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import pytest
import warp as wp

import kernels
from kernels import device as devices
from kernels.device import PACK_CUDA
from kernels.photometric.model.lobes import Lobes, Reflectance
from kernels.photometric.model.samples import LANES_CUDA
from tests.kernels.cubin import Resources, resources

pytestmark = pytest.mark.long

devices.names()
OLDEST = min(wp.get_cuda_supported_archs(), default=None)
WIDTHS = {"pack": PACK_CUDA, "lanes": LANES_CUDA}
A_COUNT = 5
"""What is given for a count that bounds a loop."""
SINE_DEPOT = {"28"}
"""Bytes of local memory that CUDA's sine takes for angles far beyond a turn, which do not occur."""
TREE_DEPOT = {"surface.nearest._nearest": {"128"}}
"""The nodes that Warp's queries of a mesh have yet to visit, 32 of 4 bytes."""


def modules() -> list[Any]:
    return [importlib.import_module(found.name) for found in pkgutil.walk_packages(kernels.__path__, "kernels.")]


def factories(module: Any) -> Iterator[tuple[str, Any]]:
    for name, value in vars(module).items():
        made_once = isinstance(value, _lru_cache_wrapper) or (inspect.isfunction(value) and hasattr(value, "__wrapped__"))  # cache, once
        if made_once and value.__module__ == module.__name__:
            yield name, value


def values_of(name: str, parameter: inspect.Parameter) -> list[Any]:
    """Return what an argument of a factory can be, its default first."""
    kind = parameter.annotation
    if name in WIDTHS:
        return [WIDTHS[name]]
    if kind is bool:
        values: list[Any] = [True, False]
    elif get_origin(kind) is Literal:
        values = list(get_args(kind))
    elif name == "dtype":
        values = [wp.float16, wp.uint8, wp.float32]
    elif kind is int:
        values = [A_COUNT]
    elif kind in (Lobes, Reflectance):
        values = [make(*(values_of(n, p)[0] for n, p in inspect.signature(make).parameters.items()))
                  for module in modules() for _, make in factories(module) if inspect.signature(make).return_annotation is kind]
    else:
        raise AssertionError(f"a kernel's factory takes {name}: {kind}, whose values this test does not know")
    if parameter.default is not parameter.empty:
        values.sort(key=lambda value: value != parameter.default)
    return values


def variants(make: Any) -> Iterator[dict[str, Any]]:
    """Return arguments for a factory: the first value of each, then every other value of one beside the first of the others."""
    choices = {name: values_of(name, parameter) for name, parameter in inspect.signature(make).parameters.items()}
    first = {name: values[0] for name, values in choices.items()}
    yield first
    for name, values in choices.items():
        for value in values[1:]:
            yield first | {name: value}


def discovered() -> dict[str, Any]:
    """Return what makes each Warp module of kernels to compile, under the name of its kernel."""
    found = {}
    shared = set()
    for module in modules():
        place = module.__name__.removeprefix("kernels.")
        for name, value in vars(module).items():
            if isinstance(value, wp.Kernel) and value.func.__module__ == module.__name__ and value.module.name not in shared:
                shared.add(value.module.name)  # kernels of a file that share a Warp module are compiled together
                found[f"{place}.{name}"] = partial(lambda kernel: kernel, value)
        for name, make in factories(module):
            parameters = inspect.signature(make).parameters
            if not name.endswith("_kernel") or not parameters:
                continue
            for number, arguments in enumerate(variants(make)):
                found[f"{place}.{name}, {number}" if number else f"{place}.{name}"] = partial(make, **arguments)
    return found


KERNELS = discovered()
TABLE = Path(__file__).with_name("cuda_resources.txt")
TITLE, *LINES = TABLE.read_text(encoding="utf-8").splitlines()
HOT = {name: Resources(*map(int, numbers)) for name, *numbers, _ in (line.rsplit(maxsplit=len(Resources._fields) + 1) for line in LINES)}
H100 = 90


def test_kernels_are_discovered():
    assert {"photometric.lambertian.lambert._lambert_kernel", "photometric.search.search_kernel.search_kernel",
            "structured.stripe._stripe_kernel",
            "surface.multigrid._smooth_from_zero", "tof.continuous.flying._flying_kernel"} <= KERNELS.keys()
    for module in modules():
        source = inspect.getsource(module)
        place = module.__name__.removeprefix("kernels.")
        if not hasattr(module, "__path__"):  # a package
            assert bool(re.search(r"wp\.kernel\b", source)) == any(name.startswith(f"{place}.") for name in KERNELS), place


@pytest.mark.skipif(OLDEST is None, reason="this build of Warp has no CUDA compiler")
@pytest.mark.parametrize("name", KERNELS)
def test_kernel_compiles_for_cuda_and_keeps_its_packs_in_registers(name, tmp_path):
    wp.compile_aot_module(KERNELS[name]().module, arch=OLDEST, module_dir=tmp_path, use_ptx=True)
    path, = tmp_path.glob("*.ptx")
    ptx = path.read_text(encoding="latin-1").rstrip("\0")
    # an array indexed at run time would lie in local memory: slow
    assert ".entry" in ptx and set(re.findall(r"__local_depot\d+\[(\d+)\]", ptx)) <= SINE_DEPOT | TREE_DEPOT.get(name, set())
    assert "_backward" not in ptx  # nothing is differentiated
    if name in HOT:
        found, known = measured(name, tmp_path), HOT[name]
        assert found.wide >= known.wide and all(now <= then for now, then in zip(found[:-1], known[:-1], strict=True)), \
            f"{found}, and before {known}: see {TABLE.name}"


def measured(name: str, folder: Path) -> Resources:
    """Return what the kernels of a Warp module take on an H100."""
    wp.compile_aot_module(KERNELS[name]().module, arch=H100, module_dir=folder, use_ptx=False)
    path, = folder.glob("*.cubin")
    return resources(path)


def write_table() -> None:
    """Write the table of the kernels that it names anew."""
    with tempfile.TemporaryDirectory() as folder:
        taken = {name: measured(name, Path(tempfile.mkdtemp(dir=folder))) for name in HOT}
    lines = [f"{name:55s} {' '.join(f'{number:4d}' for number in (*found, found.warps))}" for name, found in taken.items()]
    TABLE.write_text("\n".join([TITLE, *lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    write_table()
