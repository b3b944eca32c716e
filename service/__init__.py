"""The roof: one folder a product, where stage and kernels meet; and the doors that people use."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("relit")
except PackageNotFoundError:  # run from a checkout that was never installed
    __version__ = "0+unknown"
