"""relit depth, separate, scan, simulate and patterns: from projected light, lasers and time of flight, and what to project."""

from typing import Annotated, Any

import typer

from service.cli.groups import make_group
from service.cli.printing import check_single, counted, print_lines, print_sequence, print_warnings
from service.cli.progress import with_bar
from service.cli.request_commands import Given, local_command, product_command
from service.errors import RequestError
from service.requests.depth import DepthRequest, ScanRequest, SeparateRequest, SimulateCwRequest, SimulatePulsedRequest
from service.requests.patterns import CodeOptions, PatternsRequest, PlanRequest

PlanOption = Annotated[bool, typer.Option("--plan", help="Print images, time and precision of every code.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    local_command(app, "depth", _depth)
    product_command(app, "separate", SeparateRequest, "service.depth.separate:separate", _separate)
    product_command(app, "scan", ScanRequest, "service.depth.scan:scan", _scan)
    kinds = make_group("simulate", help="The raw frames that a time-of-flight camera would make of a depth.")
    for name, model in (("cw", SimulateCwRequest), ("pulsed", SimulatePulsedRequest)):
        product_command(kinds, name, model, "service.depth.tof.simulate:simulate_tof", lambda path: print(f"capture  {path}"))
    app.add_typer(kinds)
    local_command(app, "patterns", _patterns)


def _depth(request: DepthRequest) -> None:
    from stage.capture.sequence import is_sequence

    if is_sequence(request.capture):
        from service.sequences.run import depth_sequence

        print_sequence(with_bar(depth_sequence, request))
        return
    from service.depth.depth import depth

    check_single(request)
    result = with_bar(depth, request)
    if result.points_path is None:
        print(f"decoded  {result.depth_path} (projector coordinates, no depth)")
        print_lines(report=result.report_path, method=result.method)
    else:
        print_lines(depth=result.depth_path, points=result.points_path, report=result.report_path,
                    method=f"{result.method}, {result.points} points")
    print(f"pixels   {counted(result.counts)}")
    print_warnings(result.warnings)
    if not result.counts.get("ok"):
        raise typer.Exit(1)


def _separate(result: Any) -> None:
    print_lines(parts=result.separation_path, report=result.report_path)
    print(f"global   {100 * result.global_share.get('median', 0.0):.3g} % of the light (median), period of {result.period_px:g} px")
    print(f"pixels   {counted(result.counts)}")


def _scan(result: Any) -> None:
    print_lines(points=result.points_path, usd=result.usd_path, las=result.las_path, report=result.report_path,
                shots=counted(result.counts))


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
    from service.depth.patterns.projection import make_plan

    rows = make_plan(request)
    print(f"{'code':<34} {'at least':>9} {'images':>9} {'seconds':>9} {'column ± px':>12} {'depth ± mm':>11}")
    for row in rows:
        depth = "" if row.depth_sigma_m is None else f"{1000 * row.depth_sigma_m:.3g}"
        cost = row.cost
        print(f"{cost.name:<34} {cost.minimum:>9} {cost.images:>9} {row.seconds:>9.3g} {cost.column_sigma_px:>12.3g} {depth:>11}")


def _write(drawn: Given[PatternsRequest], plan: bool) -> None:
    from service.depth.patterns.codes import CODES_OF_OPTION
    from service.depth.patterns.projection import make_patterns

    if plan:  # options of other codes are for the table
        code = drawn.values["code"]
        drawn.values = {name: value for name, value in drawn.values.items()
                        if name not in CodeOptions.model_fields or code in CODES_OF_OPTION.get(name, (code,))}
    result = with_bar(make_patterns, drawn.build())
    print(f"images   {result.images[0]} … {result.images[-1].name}")
    print(f"entries  {result.fragment}")
