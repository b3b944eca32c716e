"""relit register, fuse and compare: the poses of many scans of one object, the surface of all, and its deviations from a design."""

from typing import TYPE_CHECKING

import typer

from service.cli.printing import print_lines
from service.cli.request_commands import product_command
from service.requests.register import CompareRequest, FuseRequest, RegisterRequest

if TYPE_CHECKING:
    from service.comparison.compare import CompareResult
    from service.scans.fusion.fuse import FuseResult
    from service.scans.register import RegisterResult

MOST_PRINTED = 20
"""Regions that are printed; the table has all."""


def register(app: typer.Typer) -> None:
    """Add the commands."""
    product_command(app, "register", RegisterRequest, "service.scans.register:register_scans", _register)
    product_command(app, "fuse", FuseRequest, "service.scans.fusion.fuse:fuse", _fuse)
    product_command(app, "compare", CompareRequest, "service.comparison.compare:compare", _compare)


def _register(result: "RegisterResult") -> bool:
    print_lines(scans=result.scan_set_path, report=result.report_path, joined=f"{result.joined} of {result.scans} scans")
    if result.residual_m is not None:
        print(f"residual {1e3 * result.residual_m:.3g} mm across the surface (median of the pairs)")
    if result.sigma_m is not None and result.sigma_degrees is not None:
        print(f"sigma    {1e3 * result.sigma_m:.3g} mm and {result.sigma_degrees:.3g}° of the least sure pose")
    return result.joined == result.scans


def _fuse(result: "FuseResult") -> None:
    facts = result.facts
    print_lines(mesh=result.mesh_path, asset=result.asset_path, report=result.report_path)
    fused = sum(scan["fused"] for scan in facts["scans"])
    print(f"surface  {facts['vertices']} vertices, {facts['faces']} faces at voxels of {1e3 * facts['voxel_m']:.4g} mm, from {fused} of "
          f"{len(facts['scans'])} scans; σ {1e3 * facts['sigma_m']['median']:.3g} mm in the median")
    if (holes := facts.get("holes")) is None:
        print(f"tiles    {facts['tiles']}; {facts['area_m2']:.4g} m², {facts['open_length_m']:.4g} m of borders")
    else:
        print(f"holes    {holes['count']}, {1e3 * holes['open_length_m']:.4g} mm around; {holes['closed_share']:.1%} of the surface is "
              "there")
        if closed := {kind: count for kind in ("pinholes", "holes") if (count := holes["closed"].get(kind))}:
            print(f"closed   {' and '.join(f'{count} {kind}' for kind, count in closed.items())}")


def _compare(result: "CompareResult") -> bool:
    print_lines(scan=result.deviations_path, picture=result.picture_path, report=result.report_path, regions=result.regions_path)
    print(f"placed   to {1e3 * result.placement_sigma_m:.3g} mm (σ along the surface's normal)")
    print(f"deviates {1e3 * result.median_m:+.3g} mm in the median, {1e3 * result.rms_m:.3g} mm RMS; σ of a point "
          f"{1e3 * result.sigma_m:.3g} mm")
    if result.regions:
        print(f"faults   of {1e3 * result.smallest_fault_m:.3g} mm across and more are looked for")
    for region in result.regions[:MOST_PRINTED]:
        extremes = "" if region.least_m is None or region.most_m is None else (
            f" {1e3 * region.least_m:+.3g} to {1e3 * region.most_m:+.3g} mm, ± {1e3 * (region.most_sigma_m or 0):.2g}")
        print(f"region   {region.name}: {region.verdict}{extremes}; allowed {1e3 * region.low_m:+.3g} to {1e3 * region.high_m:+.3g}, "
              f"{region.seen:.0%} seen" + (f", something else on {region.strange} patches" if region.strange else ""))
    if len(result.regions) > MOST_PRINTED:
        print(f"regions  {len(result.regions) - MOST_PRINTED} more are in the table")
    return result.passed
