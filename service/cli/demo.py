"""relit demo."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import DeviceOption


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("demo")(demo)


def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder for the results.")] = Path("relit-demo"),
    device: DeviceOption = None,
) -> None:
    """The main job on the shipped sample: solve, export, relight."""
    from service.cli.bar import Bar
    from service.pipelines.demo import demo as run

    with Bar() as bar:
        result = run(out, device=device, progress=bar)
    print(f"maps     {result.solved.maps_path}")
    print(f"report   {result.solved.report_path}")
    print(f"asset    {result.asset}")
    print(f"frames   {result.frames[0]} … {result.frames[-1].name}")
    print(f"picture  {result.preview}")
