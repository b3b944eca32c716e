"""relit export, basis and join: assets of results, coefficient images of a capture, and maps joined with a depth."""

import typer

from service.cli.printing import print_warnings
from service.cli.progress import with_bar
from service.cli.request_commands import local_command
from service.requests.basis import BasisRequest
from service.requests.export import ExportRequest
from service.requests.solve import JoinRequest


def register(app: typer.Typer) -> None:
    """Add the commands."""
    local_command(app, "export", _export)
    local_command(app, "basis", _basis)
    local_command(app, "join", _join)


def _export(request: ExportRequest) -> None:
    from service.export.export import export

    exported = with_bar(export, request)
    print(f"asset    {exported.path}")
    for layer in exported.lights:
        print(f"lights   {layer}")
    for name, (vertices, faces) in exported.sizes.items():
        print(f"{name:<8} {vertices} vertices, {faces} faces")
    print_warnings(exported.warnings)


def _join(request: JoinRequest) -> None:
    from service.joining.join import join

    result = with_bar(join, request)
    pixels, sigma = result.facts["pixels"], result.facts["sigma_m"]
    print(f"maps     {result.maps_path}")
    print(f"report   {result.report_path}")
    print(f"pixels   {pixels['solved']} solved of {pixels['mask']}, {pixels['with_depth']} with a depth")
    print(f"sigma    {sigma['joined_median'] * 1000:.3g} mm, of the depth alone {sigma['depth_median'] * 1000:.3g} mm")
    print_warnings(result.warnings)


def _basis(request: BasisRequest) -> None:
    from service.basis.basis import make_basis

    result = with_bar(make_basis, request)
    print(f"basis    {result.path}")
    print(f"facts    {result.facts_path}")
    shown = "" if result.levels_rms is None else f" of what is shown, {result.levels_rms:.1f} of 255"
    print(f"error    {100 * result.relative_rms:.3g} % RMS{shown}: {result.terms} coefficients a channel, {result.lights} lights, "
          f"{result.pixels} pixels")
    if result.key_lights_rms is not None:
        print(f"error    {100 * result.key_lights_rms:.3g} % RMS of pictures under lights from between the captured ones")
    if result.left_out:
        print(f"lights   {result.left_out} are not in front of the object and are left out")
    if result.near_lights:
        print(f"lights   {result.near_lights} near lights are taken as distant, as the object's centre sees them")
