"""The command line of benchmarks.clients: render, compare, parts."""

import argparse
import tempfile
from pathlib import Path

import numpy as np

import benchmarks.clients
from benchmarks.clients import parts
from benchmarks.clients.comparison import compare
from benchmarks.clients.render import Client, Environment, Sun, render
from benchmarks.relighting import rgb
from stage.capture.capture import Capture
from stage.formats import exr


def main() -> None:
    """Run one of the commands."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.clients", description=benchmarks.clients.__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)

    shown = commands.add_parser("render", help="open an asset in a program and write its picture")
    shown.add_argument("client", type=Client, choices=list(Client))
    shown.add_argument("asset", type=Path)
    shown.add_argument("--environment", type=Path)
    shown.add_argument("--sun", help="x,y,z towards the light")
    shown.add_argument("--irradiance", type=float, default=np.pi)
    shown.add_argument("--samples", type=int, default=parts.SAMPLES)
    shown.add_argument("--out", type=Path, required=True)

    compared = commands.add_parser("compare", help="print how a picture differs from the truth")
    compared.add_argument("picture", type=Path)
    compared.add_argument("reference", type=Path)
    compared.add_argument("--truth", type=Path, help="EXR with metal.Y, for the energy of metals")
    for each in (shown, compared):
        each.add_argument("--capture", type=Path, required=True, help="folder whose camera and mask are taken")

    measured = commands.add_parser("parts", help="measure captures of samples/make_parts.py")
    measured.add_argument("captures", type=Path, nargs="+")
    measured.add_argument("--maps", type=Path, help="folder with solved maps by the captures' names; else they are solved")
    measured.add_argument("--clients", nargs="+", type=Client, choices=list(Client), default=list(Client))
    measured.add_argument("--assets", nargs="+", choices=list(parts.ASSETS), default=list(parts.ASSETS))
    measured.add_argument("--samples", type=int, default=parts.SAMPLES)
    measured.add_argument("--work", type=Path, help="folder where assets and pictures are kept")
    measured.add_argument("--picture", type=Path, help="sheet of the first capture")

    given = parser.parse_args()
    {"render": _render, "compare": _compare, "parts": _parts}[given.command](given)


def _render(given: argparse.Namespace) -> None:
    capture = Capture.open(given.capture)
    if given.sun:
        direction = np.array([float(each) for each in given.sun.split(",")])
        x, y, z = (direction / np.linalg.norm(direction)).tolist()
        light: Sun | Environment = Sun((x, y, z), (given.irradiance,) * 3)
    else:
        light = Environment(rgb(given.environment))
    picture = render(given.client, given.asset, capture.manifest.camera, light, samples=given.samples)
    exr.write(given.out, dict(zip("RGBA", np.moveaxis(picture, -1, 0), strict=True)), color_space="lin_rec709_scene", metadata={})
    print(given.out)


def _compare(given: argparse.Namespace) -> None:
    metal = None if given.truth is None else exr.read(given.truth)[0]["metal.Y"]
    figures = compare(rgb(given.picture), rgb(given.reference), Capture.open(given.capture).mask(), metal)
    print(", ".join(f"{name} {value:.3f}" for name, value in figures._asdict().items()))


def _parts(given: argparse.Namespace) -> None:
    with tempfile.TemporaryDirectory() as folder:
        work = given.work or Path(folder)
        for number, capture in enumerate(given.captures):
            assets = parts.make_assets(capture, work / capture.name, given.maps and given.maps / capture.name, tuple(given.assets))
            rows = []
            for row in parts.measure(capture, assets, tuple(given.clients), pictures=work / capture.name, samples=given.samples):
                rows.append(row)
                print(parts.table(capture.name, rows)[-1], flush=True)
            print("\n".join(parts.table(capture.name, rows)))
            if given.picture and number == 0:
                parts.write_picture(capture, work / capture.name, given.assets[0], tuple(given.clients), given.picture)


if __name__ == "__main__":
    main()
