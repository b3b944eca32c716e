"""relit calibrate tof: a time-of-flight camera from a sweep over known distances."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.options import DeviceOption


def register(kinds: typer.Typer) -> None:
    """Add the kind."""
    kinds.command("tof")(tof)


def tof(
    sweep: Annotated[Path, typer.Argument(metavar="SWEEP", help="A relit.tof-sweep/1 file: captures and their distances.",
                                          show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="The relit.tof/1 file to write.", show_default=False)],
    device: DeviceOption = None,
) -> None:
    """Wiggling, scale, offset and drift of a time-of-flight camera from captures of a flat target at known distances."""
    from service.calibrate.tof import calibrate_tof
    from service.cli.bar import Bar

    with Bar() as bar:
        result = calibrate_tof(sweep, out, device=device, progress=bar)
    print(f"file     {result.path}")
    drift = result.calibration.temperature
    found = [f"wiggling at {harmonics.modulation_hz / 1e6:g} MHz" for harmonics in result.calibration.harmonics]
    found += [f"scale {result.calibration.scale:.5g}", f"offset {1000 * result.calibration.offset_m:.2f} mm"]
    found += [] if drift is None else [f"drift {1000 * drift.metres_per_c:.3f} mm a degree"]
    print(f"found    {', '.join(found)}")
    print(f"error    {1000 * result.before_m:.2f} mm before, {1000 * result.after_m:.2f} mm after, RMS over {result.steps} steps")
