"""The devices of this machine, asked for in a process of its own: the API never loads CUDA, whose failing driver would end it.

That process imports this module, which therefore imports nothing of the API.
"""

import multiprocessing
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from service.server.base.settings import Settings

CPU = "cpu"
"""The device that every machine has: no process needs to look for it."""


def of_workers(settings: "Settings") -> list[str]:
    """Return the device of each worker that `relit serve` starts: those of the settings, else every CUDA device, else the CPU."""
    from service.server.base.settings import NO_WORKER

    if settings.devices == (NO_WORKER,):
        return []
    if settings.devices:
        return [resolve(device) for device in settings.devices]
    return [name for name in _elsewhere("names") if name.startswith("cuda")] or [CPU]


def resolve(device: str | None) -> str:
    """Return the name of a device of this machine; None: of the best. Raise DeviceError if it is not on this machine."""
    return device if device == CPU else _elsewhere("resolve", device)


def _elsewhere(function: str, *arguments: object) -> Any:
    """Call a function of kernels.device in another process, and log what it says of a driver that is too old."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        answer, outdated = pool.apply(_ask, (function, arguments))
    if outdated is not None:
        from service.server.base.log import logger

        logger.warning(outdated)
    return answer


def _ask(function: str, arguments: tuple[object, ...]) -> tuple[Any, str | None]:
    from kernels import device

    return getattr(device, function)(*arguments), device.outdated_driver()
