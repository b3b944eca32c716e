"""The devices of this machine, asked for in a process of its own: the API never loads CUDA, whose failing driver would end it.

That process imports this module, which therefore imports nothing of the API.
"""

import multiprocessing
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from service.server.base.settings import Settings

T = TypeVar("T")
CPU = "cpu"
"""The device that every machine has: no process needs to look for it."""


def of_workers(settings: "Settings") -> list[str]:
    """Return the device of each worker that `relit serve` starts: those of the settings, else every CUDA device, else the CPU."""
    from service.server.base.settings import NO_WORKER

    if settings.devices == (NO_WORKER,):
        return []
    if settings.devices:
        return [resolve(device) for device in settings.devices]
    return [name for name in _elsewhere(_names) if name.startswith("cuda")] or [CPU]


def resolve(device: str | None) -> str:
    """Return the name of a device of this machine; None: of the best. Raise DeviceError if it is not on this machine."""
    return device if device == CPU else _elsewhere(_resolve, device)


def _elsewhere(ask: Callable[..., T], *arguments: object) -> T:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(ask, arguments)


def _names() -> list[str]:
    from kernels.device import names

    return names()


def _resolve(device: str | None) -> str:
    from kernels.device import resolve

    return resolve(device)
