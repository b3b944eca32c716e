"""Errors of the kernels package.

KernelError
├── ArrayError     an argument has the wrong shape, type or values; raised before any launch
└── DeviceError    the device asked for does not exist here
"""


class KernelError(Exception):
    """Base of everything that kernels/ raises on purpose; its text is one plain sentence."""


class ArrayError(KernelError, ValueError):
    """An argument cannot be used: the message says what was got, what was expected and what to do."""


class DeviceError(KernelError, ValueError):
    """The device that was asked for is not on this machine."""
