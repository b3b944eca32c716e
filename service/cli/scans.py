"""relit register: the poses of many scans of one object."""

import typer

from service.cli.printing import print_warnings
from service.cli.progress import ProgressBar
from service.cli.request_commands import local_command
from service.requests.register import RegisterRequest


def register(app: typer.Typer) -> None:
    """Add the commands."""
    local_command(app, "register", _register)


def _register(request: RegisterRequest) -> None:
    from service.scans.register import register_scans

    with ProgressBar() as bar:
        result = register_scans(request, bar)
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
