"""relit patterns: what to project, and what it costs."""

from typing import Annotated

import typer

from service.cli.bar import Bar
from service.cli.request_commands import Given, local_command
from service.errors import RequestError
from service.requests.patterns import CodeOptions, PatternsRequest, PlanRequest

PlanOption = Annotated[bool, typer.Option("--plan", help="Print images, time and precision of every code.")]


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "patterns", _patterns)


def _patterns(drawn: Given[PatternsRequest], planned: Given[PlanRequest], plan: PlanOption = False) -> None:
    """The images to project, and their manifest entries; or, with --plan, what each code costs."""
    shared = CodeOptions.model_fields
    writes = {"code", "out"} <= drawn.values.keys()
    if not plan and not writes:
        raise RequestError("give a CODE and --out for the images, or --plan for the table")
    idle = [] if plan else [name for name in planned.values if name not in shared]
    idle += [] if writes else [name for name in drawn.values if name not in shared]
    if idle:
        why = "the images need both CODE and --out" if plan else "it is for --plan"
        raise RequestError(f"{idle[0].replace('_', ' ')} is not used: {why}")
    if plan:
        _print_plan(planned.build())
    if writes:
        _write(drawn, plan)


def _print_plan(request: PlanRequest) -> None:
    from service.depth.projection import make_plan

    rows = make_plan(request)
    print(f"{'code':<34} {'at least':>9} {'images':>9} {'seconds':>9} {'column ± px':>12} {'depth ± mm':>11}")
    for row in rows:
        depth = "" if row.depth_sigma_m is None else f"{1000 * row.depth_sigma_m:.3g}"
        print(f"{row.name:<34} {row.minimum:>9} {row.images:>9} {row.seconds:>9.3g} {row.column_sigma_px:>12.3g} {depth:>11}")


def _write(drawn: Given[PatternsRequest], plan: bool) -> None:
    from service.depth.codes import CODES_OF_OPTION
    from service.depth.projection import make_patterns

    if plan:  # options of other codes are for the table
        code = drawn.values["code"]
        drawn.values = {name: value for name, value in drawn.values.items()
                        if name not in CodeOptions.model_fields or code in CODES_OF_OPTION.get(name, (code,))}
    with Bar() as bar:
        result = make_patterns(drawn.build(), bar)
    print(f"images   {result.images[0]} … {result.images[-1].name}")
    print(f"entries  {result.fragment}")
