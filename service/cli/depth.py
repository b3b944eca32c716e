"""relit depth: structured light, laser or time of flight."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import CacheOption, CaptureArgument, DeviceOption
from service.requests.depth import Ranging, WhichReturn


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("depth")(depth)


def depth(
    capture: CaptureArgument,
    out: Annotated[Path, typer.Option("--out", help="Folder for depth.exr, points.ply and report.json.", show_default=False)],
    using: Annotated[Ranging | None, typer.Option(
        "--using", show_default=False, help="Which frames, where the capture holds several kinds: pattern, laser or tof.")] = None,
    near_m: Annotated[float | None, typer.Option("--near-m", help="Depths below, in metres, are out of range.",
                                                 show_default=False)] = None,
    far_m: Annotated[float | None, typer.Option("--far-m", help="Depths above, in metres, are out of range.",
                                                show_default=False)] = None,
    max_residual_px: Annotated[float, typer.Option(
        "--max-residual-px", help="Where columns and rows are decoded: projector pixels by which they may contradict each other.")] = 4.0,
    refine: Annotated[bool, typer.Option(
        "--refine/--no-refine", help="Interpolate a Gray code with inverses between the edges of its stripes.")] = True,
    read_noise: Annotated[float, typer.Option(
        "--read-noise", help="Noise of a reading in the dark, as a part of full scale.")] = 0.003,
    photon_gain: Annotated[float, typer.Option(
        "--photon-gain", help="Photon noise: full scale over the electrons that fill a pixel.")] = 1e-4,
    filters: Annotated[str, typer.Option(
        "--filter", help="Time of flight: flying (take out mixed pixels), bilateral (smooth), or both with a comma.")] = "",
    which: Annotated[WhichReturn, typer.Option("--return", help="Time of flight, pulsed: the return that is the depth.")]
    = WhichReturn.STRONGEST,
    vote: Annotated[bool, typer.Option("--vote/--no-vote", help="Time of flight, cw: neighbours decide between wraps.")] = True,
    tof_calibration: Annotated[Path | None, typer.Option(
        "--tof-calibration", show_default=False, help="Noise, wiggling, offset, drift and pulse of a camera: relit.tof/1.")] = None,
    temperature_c: Annotated[float | None, typer.Option(
        "--temperature-c", show_default=False, help="Of the camera, for a calibration with a temperature drift.")] = None,
    normals: Annotated[bool, typer.Option("--normals", help="Write nx ny nz into points.ply too.")] = False,
    device: DeviceOption = None,
    cache: CacheOption = None,
) -> None:
    """Depth from projected patterns, a laser or time of flight."""
    from service.cli.bar import Bar
    from service.depth.depth import depth as run
    from service.requests.depth import DepthRequest, TofOptions

    tof = TofOptions.model_validate({"filters": filters, "which": which, "vote": vote, "calibration": tof_calibration,
                                     "temperature_c": temperature_c})
    with Bar() as bar:
        result = run(DepthRequest(capture=capture, out=out, using=using, near_m=near_m, far_m=far_m, max_residual_px=max_residual_px,
                                  refine=refine, read_noise=read_noise, photon_gain=photon_gain, normals=normals, tof=tof,
                                  device=device, cache=cache), bar)
    print(f"depth    {result.depth_path}")
    print(f"points   {result.points_path}")
    print(f"report   {result.report_path}")
    print(f"method   {result.method}, {result.points} points")
    print(f"pixels   {', '.join(f'{count} {name}' for name, count in result.counts.items() if count)}")
