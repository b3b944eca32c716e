"""relit register and fuse: the poses of many scans of one object, and the surface of all."""

import typer

from service.cli.printing import print_warnings
from service.cli.progress import with_bar
from service.cli.request_commands import local_command
from service.requests.register import FuseRequest, RegisterRequest


def register(app: typer.Typer) -> None:
    """Add the commands."""
    local_command(app, "register", _register)
    local_command(app, "fuse", _fuse)


def _register(request: RegisterRequest) -> None:
    from service.scans.register import register_scans

    result = with_bar(register_scans, request)
    print(f"scans    {result.scan_set_path}")
    print(f"report   {result.report_path}")
    print(f"joined   {result.joined} of {result.scans} scans")
    if result.residual_m is not None:
        print(f"residual {1e3 * result.residual_m:.3g} mm across the surface (median of the pairs)")
    if result.sigma_m is not None and result.sigma_degrees is not None:
        print(f"sigma    {1e3 * result.sigma_m:.3g} mm and {result.sigma_degrees:.3g}° of the least sure pose")
    print_warnings(result.warnings)
    if result.joined < result.scans:
        raise typer.Exit(1)


def _fuse(request: FuseRequest) -> None:
    from service.scans.fusion.fuse import fuse

    result = with_bar(fuse, request)
    facts = result.facts
    if result.mesh_path is not None:
        print(f"mesh     {result.mesh_path}")
    if result.asset_path is not None:
        print(f"asset    {result.asset_path}")
    print(f"report   {result.report_path}")
    fused = sum(scan["fused"] for scan in facts["scans"])
    print(f"surface  {facts['vertices']} vertices, {facts['faces']} faces at voxels of {1e3 * facts['voxel_m']:.4g} mm, from {fused} of "
          f"{len(facts['scans'])} scans; σ {1e3 * facts['sigma_m']['median']:.3g} mm in the median")
    if (holes := facts.get("holes")) is None:
        print(f"tiles    {facts['tiles']}; {facts['area_m2']:.4g} m², {facts['open_length_m']:.4g} m of borders")
    else:
        print(f"holes    {holes['count']}, {1e3 * holes['open_length_m']:.4g} mm around; {holes['closed_share']:.1%} of the surface is "
              "there")
    print_warnings(result.warnings)
