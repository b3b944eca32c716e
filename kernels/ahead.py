"""Kernels compiled for CUDA before they are launched: for a list of architectures into a folder, or those of a package side by side.

Every kernel of kernels/ is found: those of modules, and those that a factory whose name ends with `_kernel` returns, for which the numbers
`pack` or `lanes` is that of CUDA and its other arguments are told by their annotations; each value in turn beside the first of the others.
"""

import importlib
import inspect
import pkgutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

import warp as wp

import kernels
from kernels import device as devices
from kernels.errors import DeviceError

WIDTHS = {"pack": devices.PACK_CUDA, "lanes": devices.LANES_CUDA}


@cache
def modules() -> list[Any]:
    """Return all modules of kernels/."""
    return [importlib.import_module(found.name) for found in pkgutil.walk_packages(kernels.__path__, "kernels.")]


def every_kernel() -> dict[str, Callable[[], Any]]:
    """Return what makes each kernel to compile, under its name; of kernels in one Warp module, which are compiled together, the first."""
    found: dict[str, Callable[[], Any]] = {}
    shared = set()
    for module in modules():
        place = module.__name__.removeprefix("kernels.")
        for name, value in vars(module).items():
            if isinstance(value, wp.Kernel) and value.func.__module__ == module.__name__ and value.module.name not in shared:
                shared.add(value.module.name)
                found[f"{place}.{name}"] = partial(lambda kernel: kernel, value)
        for name, make in _factories(module):
            if name.endswith("_kernel") and inspect.signature(make).parameters:
                for number, arguments in enumerate(_variants(make)):
                    found[f"{place}.{name}, {number}" if number else f"{place}.{name}"] = partial(make, **arguments)
    return found


def package_of(kernel: Any) -> list[Any]:
    """Return the Warp modules of the package of kernels/ that a kernel is of, its own first: a product needs many of them in turn."""
    package = kernel.func.__module__.split(".")[1:2]
    others = (make().module for name, make in every_kernel().items() if name.split(".")[:1] == package)
    return list(dict.fromkeys([kernel.module, *others]))


def build(folder: Path, architectures: Iterable[int], progress: Callable[[int, int], None] | None = None) -> list[Path]:
    """Compile every kernel for architectures of GPUs, with a thread for each core; no GPU is needed.

    Args:
        folder: gets a `.cubin` of each kernel and architecture and a `.meta` of each kernel, under names that tell their content; it may
            hold others.
        architectures: 90 for compute capability 9.0.
        progress: is told how many are compiled, and of how many; what it raises ends the work. Files that are there are whole.

    Returns:
        The cubins.

    Raises:
        DeviceError: this build of Warp cannot compile for one of them.
    """
    devices.names()
    known = sorted(wp.get_cuda_supported_archs())
    wanted = list(dict.fromkeys(architectures))
    for architecture in wanted:
        if architecture not in known:
            raise DeviceError(f"architecture {architecture} is not one that Warp {wp.__version__} compiles for: choose of "
                              f"{', '.join(map(str, known)) or 'none'}")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as place:

        def compile_one(module: Any, architecture: int) -> list[Path]:
            inside = Path(place, f"{id(module)}-{architecture}")
            wp.compile_aot_module(module, arch=architecture, module_dir=inside, use_ptx=False)
            found = [path for path in inside.iterdir() if path.suffix in (".cubin", ".meta")]
            return [path.replace(folder / path.name) for path in found]

        with ThreadPoolExecutor(devices.worker_count()) as pool:
            jobs = [pool.submit(compile_one, devices.cuda_module(make()), each) for make in every_kernel().values() for each in wanted]
            try:
                for number, job in enumerate(as_completed(jobs), start=1):
                    job.result()
                    if progress is not None:
                        progress(number, len(jobs))
            finally:
                pool.shutdown(cancel_futures=True)
    return sorted({path for job in jobs for path in job.result() if path.suffix == ".cubin"})


def _factories(module: Any) -> Iterator[tuple[str, Any]]:
    for name, value in vars(module).items():
        if inspect.isfunction(value) and hasattr(value, "__wrapped__") and value.__module__ == module.__name__:  # once
            yield name, value


def _values_of(name: str, parameter: inspect.Parameter) -> list[Any]:
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
    else:  # what another factory makes
        values = [made(**arguments) for module in modules() for _, made in _factories(module)
                  if inspect.signature(made).return_annotation is kind for arguments in _variants(made)]
    if not values:
        raise AssertionError(f"a kernel's factory takes {name}: {kind}, whose values are not known")
    if parameter.default is not parameter.empty:
        values.sort(key=lambda value: value != parameter.default)
    return values


def _variants(make: Any) -> Iterator[dict[str, Any]]:
    """Yield arguments for a factory: the first value of each, then every other value of one beside the first of the others."""
    choices = {name: _values_of(name, parameter) for name, parameter in inspect.signature(make).parameters.items()}
    first = {name: values[0] for name, values in choices.items()}
    yield first
    for name, values in choices.items():
        for value in values[1:]:
            yield first | {name: value}
