"""relit basis: a capture reduced to a few images."""

import typer

from service.cli.bar import Bar
from service.cli.request_commands import local_command
from service.requests.basis import BasisRequest


def register(app: typer.Typer) -> None:
    """Add the command."""
    local_command(app, "basis", _basis)


def _basis(request: BasisRequest) -> None:
    from service.basis.basis import make_basis

    with Bar() as bar:
        result = make_basis(request, bar)
    print(f"basis    {result.path}")
    print(f"facts    {result.facts_path}")
    shown = "" if result.levels_rms is None else f" of what is shown, {result.levels_rms:.1f} of 255"
    print(f"error    {100 * result.relative_rms:.3g} % RMS{shown}: {result.terms} coefficients a channel, {result.lights} lights, "
          f"{result.pixels} pixels")
    if result.left_out:
        print(f"lights   {result.left_out} are not in front of the object and are left out")
    if result.near_lights:
        print(f"lights   {result.near_lights} near lights are taken as distant, as the object's centre sees them")
