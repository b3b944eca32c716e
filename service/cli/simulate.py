"""relit simulate: the raw frames that a time-of-flight camera would make of a depth."""

import typer

from service.cli.request_commands import local_command
from service.requests.simulate import SimulateCwRequest, SimulatePulsedRequest


def register(app: typer.Typer) -> None:
    """Add the command and its kinds."""
    kinds = typer.Typer(name="simulate", no_args_is_help=True, help="The raw frames that a time-of-flight camera would make of a depth.")
    local_command(kinds, "cw", _cw)
    local_command(kinds, "pulsed", _pulsed)
    app.add_typer(kinds)


def _cw(request: SimulateCwRequest) -> None:
    _simulate(request)


def _pulsed(request: SimulatePulsedRequest) -> None:
    _simulate(request)


def _simulate(request: SimulateCwRequest | SimulatePulsedRequest) -> None:
    from service.depth.simulate import simulate_tof

    print(f"capture  {simulate_tof(request)}")
