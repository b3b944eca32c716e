"""The products of Relit, one folder each, in which stage and kernels meet, and the ways to use them."""

__version__: str


def __getattr__(name: str) -> str:
    """Return `__version__`, that of the installed package; to look it up takes as long as to start Python."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version

    try:
        globals()[name] = version("relit")
    except PackageNotFoundError:  # run from a checkout that was never installed
        globals()[name] = "0+unknown"
    return str(globals()[name])
