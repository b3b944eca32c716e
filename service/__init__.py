"""The products of Relit, one folder each, in which stage and kernels meet, and the ways to use them."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("relit")
except PackageNotFoundError:  # run from a checkout that was never installed
    __version__ = "0+unknown"
