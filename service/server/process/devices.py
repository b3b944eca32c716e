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
    names, outdated = _elsewhere(_names)
    _warn(outdated)
    return [name for name in names if name.startswith("cuda")] or [CPU]


def resolve(device: str | None) -> str:
    """Return the name of a device of this machine; None: of the best. Raise DeviceError if it is not on this machine."""
    if device == CPU:
        return device
    name, outdated = _elsewhere(_resolve, device)
    _warn(outdated)
    return name


def _warn(outdated: str | None) -> None:
    if outdated is not None:
        from service.server.base.log import logger

        logger.warning(outdated)


def _elsewhere(ask: Callable[..., T], *arguments: object) -> T:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(ask, arguments)


def _names() -> tuple[list[str], str | None]:
    from kernels.device import names, outdated_driver

    return names(), outdated_driver()


def _resolve(device: str | None) -> tuple[str, str | None]:
    from kernels.device import outdated_driver, resolve

    return resolve(device), outdated_driver()
