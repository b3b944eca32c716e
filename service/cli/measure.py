"""relit bench: the speed table, measured here and now."""

from typing import Annotated

import typer

from service.cli.options import DeviceOption


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("bench")(bench)


def bench(
    device: DeviceOption = None,
    repeats: Annotated[int, typer.Option("--repeats", min=3, help="Timed runs of each; medians are shown.")] = 9,
) -> None:
    """Speed of the kernels against NumPy and against a plain copy, in the same run."""
    from service.cli.bar import Bar
    from service.demo.bench import bench as run

    with Bar() as bar:
        lines = run(device, repeats, bar)
    print("\n".join(lines))
