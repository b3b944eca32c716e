"""relit simulate: the raw frames that a time-of-flight camera would make of a depth."""

from pathlib import Path
from typing import Annotated

import typer

DepthArgument = Annotated[Path, typer.Argument(metavar="DEPTH", help="A depth.exr, or its folder.", show_default=False)]
OutOption = Annotated[Path, typer.Option("--out", help="Folder of the capture.", show_default=False)]
AlbedoOption = Annotated[float, typer.Option("--albedo", help="Of every surface.")]
SeedOption = Annotated[int, typer.Option("--seed", help="Of the noise.")]
NoiseOption = Annotated[bool, typer.Option("--noise/--no-noise", help="Shot and read noise.")]


def register(app: typer.Typer) -> None:
    """Add the command and its kinds."""
    kinds = typer.Typer(name="simulate", no_args_is_help=True, help="The raw frames that a time-of-flight camera would make of a depth.")
    kinds.command("cw")(cw)
    kinds.command("pulsed")(pulsed)
    app.add_typer(kinds)


def cw(
    depth: DepthArgument,
    out: OutOption,
    modulation_hz: Annotated[str, typer.Option("--modulation-hz", help="Frequencies, with commas between.")] = "20e6,30e6,80e6",
    phases: Annotated[int, typer.Option("--phases", help="Images a frequency, evenly spaced in phase.")] = 4,
    signal_electrons: Annotated[float, typer.Option(
        "--signal-electrons", help="Of a white surface at one metre, in one image.")] = 1e5,
    ambient_electrons: Annotated[float, typer.Option("--ambient-electrons", help="Of a white surface.")] = 0.0,
    read_noise_electrons: Annotated[float, typer.Option("--read-noise-electrons", help="Standard deviation.")] = 5.0,
    full_well: Annotated[float | None, typer.Option("--full-well", help="Electrons at which a reading saturates.",
                                                    show_default=False)] = None,
    albedo: AlbedoOption = 0.5,
    seed: SeedOption = 0,
    noise: NoiseOption = True,
) -> None:
    """Correlation images of a continuous-wave camera."""
    from service.depth.simulate import simulate_tof
    from service.requests.simulate import SimulateCwRequest

    request = SimulateCwRequest.model_validate({
        "depth": depth, "out": out, "modulation_hz": modulation_hz, "phases": phases, "signal_electrons": signal_electrons,
        "ambient_electrons": ambient_electrons, "read_noise_electrons": read_noise_electrons, "full_well": full_well, "albedo": albedo,
        "seed": seed if noise else None})
    print(f"capture  {simulate_tof(request)}")


def pulsed(
    depth: DepthArgument,
    out: OutOption,
    bins: Annotated[int, typer.Option("--bins", help="Of a histogram.")] = 64,
    bin_s: Annotated[float, typer.Option("--bin-s", help="Seconds a bin.")] = 1.5e-9,
    pulse_sigma_s: Annotated[float, typer.Option("--pulse-sigma-s", help="Standard deviation of the pulse, seconds.")] = 1.2e-9,
    signal_photons: Annotated[float, typer.Option("--signal-photons", help="Of a white surface at one metre, all pulses.")] = 4000.0,
    background: Annotated[float, typer.Option("--background", help="Photons a bin, all pulses.")] = 0.5,
    pulses: Annotated[int | None, typer.Option("--pulses", help="With it, only the first photon after each pulse is counted.",
                                               show_default=False)] = None,
    albedo: AlbedoOption = 0.5,
    seed: SeedOption = 0,
    noise: NoiseOption = True,
) -> None:
    """Photon histograms of a pulsed camera."""
    from service.depth.simulate import simulate_tof
    from service.requests.simulate import SimulatePulsedRequest

    request = SimulatePulsedRequest(depth=depth, out=out, bins=bins, bin_s=bin_s, pulse_sigma_s=pulse_sigma_s,
                                    signal_photons=signal_photons, background=background, pulses=pulses, albedo=albedo,
                                    seed=seed if noise else None)
    print(f"capture  {simulate_tof(request)}")
