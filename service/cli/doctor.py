"""relit doctor: is this installation sound?"""

from typing import Annotated

import typer

ROOTS = ("stage", "kernels", "service")

DoctorDevice = Annotated[str | None, typer.Option("--device", help="Check this device; without it all.", show_default=False)]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("doctor")(doctor)


def doctor(only: DoctorDevice = None) -> None:
    """Check this installation: versions, shadowed packages, devices, a kernel, a writable kernel cache."""
    import importlib.util
    import tempfile
    from pathlib import Path

    from service import __version__
    from service.provenance import versions

    faults = []
    for name, value in versions().items():
        print(f"{name:<12} {value}")
        if value == "not installed":
            faults.append(f"{name} is not installed")
    home = Path(__file__).resolve().parents[2]
    for root in ROOTS:
        spec = importlib.util.find_spec(root)
        found = Path(spec.origin).resolve().parent if spec is not None and spec.origin else None
        if found != home / root:
            faults.append(f"package {root} is taken from {found}, not from relit {__version__} in {home}: "
                          "install relit in an environment of its own")
    if not faults:
        import numpy as np

        from kernels import device, packs
        from kernels.relight.combine import combine

        for name in [device.resolve(only)] if only else device.names():
            band = packs.upload(np.ones((3, 8, 64), dtype=np.float16), device=name)
            sound = bool((combine(band, np.full((3, 8), 0.25, dtype=np.float32)).numpy() == 2.0).all())
            print(f"{'device':<12} {device.describe(name)}: {'works' if sound else 'gives wrong sums'}")
            if not sound:
                faults.append(f"{name} gives wrong sums")
        with tempfile.TemporaryDirectory() as folder:
            print(f"{'temporary':<12} {folder} can be written")
    for fault in faults:
        print(f"{'wrong':<12} {fault}")
    print("sound" if not faults else f"{len(faults)} faults")
    if faults:
        raise typer.Exit(2)
