"""relit patterns: what to project, and what it costs."""

from pathlib import Path
from typing import Annotated, Any

import typer

from service.cli.options import HostOption
from service.requests.patterns import PatternAxis, PatternCode


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("patterns")(patterns)


def patterns(
    projector: Annotated[str, typer.Option("--projector", metavar="WxH", help="Its pixels, as in 1280x800.", show_default=False)],
    code: Annotated[PatternCode | None, typer.Argument(
        metavar="CODE", show_default=False,
        help="binary, gray, xor, kary, color, ramp, phase, gray-phase, micro or modulated; not needed with --plan.")] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for the images and patterns.json.", show_default=False)] = None,
    axis: Annotated[PatternAxis | None, typer.Option("--axis", help="The coordinate to code; without it column.",
                                                     show_default=False)] = None,
    bits: Annotated[int | None, typer.Option("--bits", help="Of a channel in the PNG files, 8 or 16; without it 8.",
                                             show_default=False)] = None,
    gamma: Annotated[float | None, typer.Option("--gamma", show_default=False,
                                                help="Of the projector: a level is stored as level^(1/gamma); without it 1.")] = None,
    stripe: Annotated[float | None, typer.Option("--stripe", help="Width of the finest stripe, pixels; without it 1, with gray-phase half "
                                                                  "a period.", show_default=False)] = None,
    inverses: Annotated[bool | None, typer.Option("--inverses/--no-inverses", show_default=False,
                                                  help="Every frame of binary, gray and xor also inverted; without it so.")] = None,
    base_bit: Annotated[int | None, typer.Option("--base-bit", help="xor: 0 for XOR-02, 1 for XOR-04.", show_default=False)] = None,
    base: Annotated[int | None, typer.Option("--base", help="kary, color: digits' base; without it 3.", show_default=False)] = None,
    reflected: Annotated[bool | None, typer.Option("--reflected/--plain", help="kary, color: neighbours differ in one digit by one; "
                                                                               "without it so.", show_default=False)] = None,
    periods: Annotated[str | None, typer.Option("--periods", metavar="P,P,…", show_default=False,
                                                help="phase, gray-phase, modulated: pixels; without it what the width needs.")] = None,
    steps: Annotated[int | None, typer.Option("--steps", help="phase, gray-phase, modulated: of each period; without it 4.",
                                              show_default=False)] = None,
    micro_periods: Annotated[int | None, typer.Option("--micro-periods", help="micro: how many; without it 6.", show_default=False)] = None,
    mean_period: Annotated[float | None, typer.Option("--mean-period", help="micro: about which they lie, pixels; without it 24.",
                                                      show_default=False)] = None,
    carrier: Annotated[float | None, typer.Option("--carrier", help="modulated: period of the carrier, pixels; without it 8.",
                                                  show_default=False)] = None,
    plan: Annotated[bool, typer.Option("--plan", help="Print images, time and precision of every code.")] = False,
    fps: Annotated[float | None, typer.Option("--fps", help="Plan: images a second; without it 30.", show_default=False)] = None,
    noise: Annotated[float | None, typer.Option("--noise", help="Plan: deviation of a reading over the pattern's amplitude; without it "
                                                                "0.02.", show_default=False)] = None,
    baseline: Annotated[float | None, typer.Option("--baseline", help="Plan: projector to camera, metres.", show_default=False)] = None,
    distance: Annotated[float | None, typer.Option("--distance", help="Plan: of the object, metres.", show_default=False)] = None,
    focal: Annotated[float | None, typer.Option("--focal", help="Plan: of the projector, pixels.", show_default=False)] = None,
    device: HostOption = None,
) -> None:
    """The images to project, and their manifest entries; or, with --plan, what each code costs."""
    from service.cli.bar import Bar
    from service.depth.codes import CODES_OF_OPTION
    from service.depth.projection import make_patterns, make_plan
    from service.errors import RequestError
    from service.requests.patterns import PatternsRequest, PlanRequest

    planned: dict[str, Any] = {"frame_rate": fps, "noise": noise, "baseline": baseline, "distance": distance, "focal": focal}
    drawn: dict[str, Any] = {"bits": bits, "gamma": gamma, "stripe": stripe, "inverses": inverses, "base_bit": base_bit,
                             "reflected": reflected, "mean_period": mean_period, "carrier": carrier}
    both: dict[str, Any] = {"projector": projector, "axis": axis, "base": base, "periods": periods, "steps": steps,
                            "micro_periods": micro_periods}
    writes = code is not None and out is not None
    if not plan and not writes:
        raise RequestError("give a CODE and --out for the images, or --plan for the table")
    idle = [] if plan else [name for name, value in planned.items() if value is not None]
    idle += [] if writes else [name for name, value in {"out": out, "code": code, **drawn}.items() if value is not None]
    if idle:
        why = "the images need both CODE and --out" if plan else "it is for --plan"
        raise RequestError(f"{idle[0].replace('_', ' ')} is not used: {why}")
    if plan:
        rows = make_plan(PlanRequest(**_given(planned), **_given(both)))
        print(f"{'code':<34} {'at least':>9} {'images':>9} {'seconds':>9} {'column ± px':>12} {'depth ± mm':>11}")
        for row in rows:
            depth = "" if row.depth_sigma_m is None else f"{1000 * row.depth_sigma_m:.3g}"
            print(f"{row.name:<34} {row.minimum:>9} {row.images:>9} {row.seconds:>9.3g} {row.column_sigma_px:>12.3g} {depth:>11}")
    if writes:
        shared = {name: value for name, value in _given(both).items() if not plan or code in CODES_OF_OPTION.get(name, (code,))}
        with Bar() as bar:
            result = make_patterns(PatternsRequest(**{"code": code, "out": out, **_given(drawn), **shared}), bar)
        print(f"images   {result.images[0]} … {result.images[-1].name}")
        print(f"entries  {result.fragment}")


def _given(options: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}
