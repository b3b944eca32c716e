"""relit doctor: check this installation; relit kernels: compile its kernels ahead."""

import os
from pathlib import Path
from typing import Annotated

import typer

from service.cli.commands.server import ConfigOption, DataOption, settings_of

ROOTS = ("stage", "kernels", "service")
ARCHITECTURES = 86, 89, 90
"""GPUs for which kernels are compiled ahead without --arch: Ampere's and Ada's of workstations, and Hopper."""

DoctorDevice = Annotated[str | None, typer.Option("--device", help="Check only this device; without it all.", show_default=False)]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("doctor")(doctor)
    app.command("kernels")(kernels)


def doctor(only: DoctorDevice = None, data: DataOption = None, config: ConfigOption = None) -> None:
    """Check this installation: versions, shadowed packages, devices, a kernel, a writable temporary folder; and the service here.

    The service is that of --data or --config, or of RELIT_DATA or ./relit-data where there is such a folder.
    """
    import importlib.util
    import tempfile

    from service import __version__
    from service.reporting.provenance import reported_versions

    faults = []
    for name, value in reported_versions().items():
        print(f"{name:<12} {value}")
        if value == "not installed":
            faults.append(f"{name} is not installed")
    home = Path(__file__).resolve().parents[3]
    for root in ROOTS:
        spec = importlib.util.find_spec(root)
        found = Path(spec.origin).resolve().parent if spec is not None and spec.origin else None
        if found != home / root:
            faults.append(f"package {root} is taken from {found}, not from relit {__version__} in {home}: "
                          "install relit in an environment of its own")
    if not faults:
        import numpy as np

        from kernels import device, packs
        from kernels.relight.frames.combine import combine

        for name in [device.resolve(only)] if only else device.names():
            band = packs.upload(np.ones((3, 8, 64), dtype=np.float16), device=name)
            sound = bool((device.to_numpy(combine(band, np.full((3, 8), 0.25, dtype=np.float32))) == 2.0).all())
            print(f"{'device':<12} {device.describe(name)}: {'works' if sound else 'gives wrong sums'}")
            if not sound:
                faults.append(f"{name} gives wrong sums")
        if os.environ.get("RELIT_KERNELS") and not device.MADE_AHEAD.is_dir():
            faults.append(f"{device.MADE_AHEAD}, which RELIT_KERNELS names, is no folder: kernels are compiled on this machine")
        outdated = None if only else device.outdated_driver()
        faults += [outdated] if outdated else []
        with tempfile.TemporaryDirectory() as folder:
            print(f"{'temporary':<12} {folder} can be written")
    faults += _service(data, config)
    for fault in faults:
        print(f"{'wrong':<12} {fault}")
    print("sound" if not faults else f"faults: {len(faults)}")
    if faults:
        raise typer.Exit(1)


def kernels(
    out: Annotated[Path | None, typer.Argument(help="Folder for the kernels, which RELIT_KERNELS then names; without it that of this "
                                               "installation.", show_default=False)] = None,
    arch: Annotated[list[int], typer.Option(help="Architecture of GPUs, 89 for compute capability 8.9; may be given several times.")
                    ] = list(ARCHITECTURES),  # noqa: B006
) -> None:
    """Compile all kernels for GPUs ahead, so that no machine compiles them when it first launches them; needs no GPU.

    An installation finds those in its own folder, and those in the folder that the environment variable RELIT_KERNELS names.
    """
    from kernels import ahead, device
    from service.cli.progress import ProgressBar

    folder = out or device.MADE_AHEAD
    with ProgressBar() as bar:

        def show(done: int, total: int) -> None:
            if done == 1:
                bar.stage("compile", total)
            bar.advance(done)

        made = ahead.build(folder, arch, show)
    print(f"{folder}: {len(made)} kernels for {', '.join(f'sm_{each}' for each in dict.fromkeys(arch))}, "
          f"{sum(path.stat().st_size for path in made) / 1e6:.1f} MB")


def _service(data: Path | None, config: Path | None) -> list[str]:
    """Check the service, where there is one; return what is wrong."""
    settings = settings_of(config, data=data)
    if data is None and config is None and not settings.data.is_dir():
        return []
    from service.server.process.checkup import look

    faults = []
    for found in look(settings):
        if found.fault:
            faults.append(f"{found.subject}: {found.text}")
        else:
            print(f"{found.subject:<12} {found.text}")
    return faults
