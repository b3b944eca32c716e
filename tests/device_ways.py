"""The products that work on a device, each on a small scene, and what each stage of them asks of the device.

    python -m tests.device_ways   # writes device_counts.txt anew, counted on the emulated device

The counts do not depend on the machine. Those of two sizes of the same scene tell what grows with the pixels and what does not.
"""

import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np

from kernels import device as devices
from service.depth.depth import depth
from service.relight.relight import relight
from service.relight.shade import shade
from service.requests.depth import DepthRequest
from service.requests.register import FuseRequest
from service.requests.relight import LightWeights, RelightRequest
from service.requests.shade import PointLight, ShadeRequest
from service.requests.solve import Method, SolveRequest
from service.scans.fusion.fuse import fuse
from service.scans.points.ply_points import read_ply_points
from service.solve.height import interreflection
from service.solve.methods import bounce_evidence
from service.solve.solve import solve
from stage.formats import exr
from tests import emulated_device
from tests.reference import tof
from tests.reference.projector import Device
from tests.scenes import depth as projected
from tests.scenes import glossy, near_lights
from tests.scenes.captures import write_exr
from tests.scenes.statue import turntable, write_scans
from tests.service.depth.tof.test_tof import cw_frames, pulsed_frames
from tests.service.depth.tof.test_tof import write as write_tof

TABLE = Path(__file__).with_name("device_counts.txt")
SIDES = 16, 48, 64
"""Pixels along the shorter side of the scenes that are counted. From 48 on, what is bounded by a number of pixels or patches is as many."""
PATCHES = 16
"""Patches of bounced light, and blocks whose middles settle it: as many at both sizes, and of more pixels than stand for a patch, as at
the sizes of captures."""
LIGHTS, FRAMES = 96, 3
"""The numbers of lights of the scene under distant lights, and of its relit frames."""
HALF = 2
"""Bytes of a value in the stack of images."""


class Counting:
    """A Progress that notes what each stage asked of the emulated device, under its name."""

    def __init__(self) -> None:
        self.stages: dict[str, Counter[str]] = {}
        self._name, self._before = "start", emulated_device.counts.copy()

    def stage(self, name: str, total: int) -> None:
        now = emulated_device.counts.copy()
        self.stages.setdefault(self._name, Counter()).update(now - self._before)
        self._name, self._before = name, now

    def advance(self, done: int) -> None:
        """Take no note."""

    def close(self) -> dict[str, Counter[str]]:
        """Return the counts of the stages that asked anything of the device."""
        self.stage("", 1)
        return {name: counted for name, counted in self.stages.items() if counted}


class Way(NamedTuple):
    """A product with its scene."""

    write: Callable[[Path, int], int]
    """Write the scene into a folder, with so many pixels along its shorter side; return the bytes that were captured."""
    run: Callable[[Path, Path, str, Counting], object]
    """Make results of the scene in another folder, on a device."""
    pixels: Callable[[int], int]
    """Returns how many pixels the images of the scene have together that show different places."""


def square(side: int) -> int:
    return side * side


def wide(side: int) -> int:
    return side * (side * 4 // 3)


def around(side: int) -> int:
    return 6 * 3 * side * (9 * side // 4)


def distant(folder: Path, side: int) -> int:
    """Write a glossy cap that fills the image, under distant lights around the viewer, with its true maps and an environment."""
    around = side // 4
    cap = glossy.Dome(*(plane[around:-around, around:-around] for plane in glossy.dome(side + 2 * around)))
    directions = glossy.sphere_directions(2 * LIGHTS)
    glossy.write_dome(folder / "capture", cap, directions=directions[directions[:, 2] > 0][:LIGHTS], noise=1e-3)
    glossy.write_maps(folder / "maps", cap)
    sun = glossy.lat_long(16)[0] @ np.array([0.3, 0.5, 0.81]) > 0.97
    write_exr(folder / "sky.exr", np.where(sun[..., None], [9.0, 8.0, 7.0], 0.2))
    return side * side * LIGHTS * 3 * HALF


def near(folder: Path, side: int) -> int:
    """Write a dome under near lamps."""
    scene = near_lights.dome(side)
    near_lights.write(folder / "capture", scene, near_lights.lamps(scene, 8, 3.0))
    return side * side * 8 * 3 * HALF


def patterns(folder: Path, side: int) -> int:
    """Write a sphere before a plane under Gray codes and phases."""
    camera = Device(side * 4 // 3, side, 2.0 * side, *projected.CAMERA[3:])
    shown = [*projected.phase_patterns("column", 16), *projected.gray_patterns("column", stripe=4), *projected.BLACK_WHITE]
    projected.write_patterns(folder / "capture", projected.make_scene(camera=camera), shown, noise=0.003, camera=camera)
    return camera.width * side * len(shown) * 3 * HALF


def lasers(folder: Path, side: int) -> int:
    """Write the same scene under eight planes of a laser."""
    camera = Device(side * 4 // 3, side, 7.0 * side, *projected.CAMERA[3:])
    source = np.array([0.25, 0.05, 0.0])
    planes = [{"type": "plane", "point_m": source.tolist(), "normal": np.cross(np.array([x, 0, -1.4]) - source, [0, 1, 0]).tolist()}
              for x in np.linspace(-0.04, 0.04, 8)]
    projected.write_lasers(folder / "capture", projected.make_scene(camera=camera), planes, width=0.1 / side, noise=0.004, camera=camera)
    return camera.width * side * (len(planes) + 1) * 3 * HALF


def continuous(folder: Path, side: int) -> int:
    """Write a room for a time-of-flight camera of three frequencies."""
    settings = tof.even(tof.HZ, 4)
    return _room(folder, side, lambda view: cw_frames(tof.correlations(view, 1e5, settings, seed=3), settings))


def pulsed(folder: Path, side: int) -> int:
    """Write a room as histograms of photons."""
    return _room(folder, side, lambda view: pulsed_frames(tof.histogram(view, 4000, seed=3)))


def _room(folder: Path, side: int, frames_of: Callable[[tof.View], list]) -> int:
    cols = side * 4 // 3
    frames = frames_of(tof.room(side, cols))
    write_tof(folder / "capture", frames, camera={"projection": "perspective", "resolution": [cols, side], "focal_px": [1.1 * cols] * 2})
    return sum(values.nbytes for values, _ in frames)


def scans(folder: Path, side: int) -> int:
    """Write range images all around a statue."""
    shots = turntable(6, (3 * side, 9 * side // 4))
    write_scans(folder, shots)
    return sum(shot.depth.size * 4 for shot in shots)


def solving(method: Method) -> Callable[[Path, Path, str, Counting], object]:
    return lambda folder, out, device, progress: solve(
        SolveRequest(capture=folder / "capture", out=out, method=method, device=device), progress)


def relighting(*, guided: bool, frames: int = FRAMES) -> Callable[[Path, Path, str, Counting], object]:
    return lambda folder, out, device, progress: relight(
        RelightRequest(capture=folder / "capture", environment=folder / "sky.exr", out=str(out / "f.#.exr"), frames=f"1-{frames}",
                       spin_degrees=60, weights=None if guided else LightWeights.CELLS, maps=folder / "maps" if guided else None,
                       device=device), progress)


def shading(folder: Path, out: Path, device: str, progress: Counting) -> object:
    lamp = PointLight(position_m=[0.01, 0.015, 0.03], intensity=[2e-3, 1e-3, 5e-4])
    return shade(ShadeRequest(maps=folder / "maps", out=out / "p.exr", light=(lamp,), environment=folder / "sky.exr", device=device),
                 progress)


def ranging(folder: Path, out: Path, device: str, progress: Counting) -> object:
    return depth(DepthRequest(capture=folder / "capture", out=out, device=device), progress)


def fusing(folder: Path, out: Path, device: str, progress: Counting) -> object:
    return fuse(FuseRequest(scan_set=folder, out=out, voxel_m=0.03, texture=False, device=device, threads=1), progress)


WAYS = {
    "solve lambert": Way(distant, solving(Method.LAMBERT), square),
    "solve robust": Way(distant, solving(Method.ROBUST), square),
    "solve svbrdf": Way(distant, solving(Method.SVBRDF), square),
    "solve near lights": Way(near, solving(Method.ROBUST), square),
    "relight cells": Way(distant, relighting(guided=False), square),
    "relight guided": Way(distant, relighting(guided=True), square),
    "shade": Way(distant, shading, square),
    "depth patterns": Way(patterns, ranging, wide),
    "depth laser": Way(lasers, ranging, wide),
    "depth tof cw": Way(continuous, ranging, wide),
    "depth tof pulsed": Way(pulsed, ranging, wide),
    "fuse": Way(scans, fusing, around),
}


def results(out: Path) -> dict[str, np.ndarray]:
    """Return the layers of the images in a folder of results, and how the vertices of its mesh are distributed."""
    layers = {f"{path.name} {name}": values for path in sorted(out.glob("*.exr")) for name, values in exr.read(path)[0].items()}
    mesh = out / "mesh.ply"
    return {**layers, "vertices": np.quantile(read_ply_points(mesh).points, np.linspace(0, 1, 33), axis=0)} if mesh.exists() else layers


class Row(NamedTuple):
    """What a stage of a way asked of the device, a line of the table."""

    way: str
    side: int
    captured: int
    stage: str
    counts: tuple[int, ...]
    """In the order of emulated_device.COUNTED."""

    def __str__(self) -> str:
        numbers = "".join(f"{count:>12}" for count in self.counts)
        return f"{self.way:<18}{self.side:>4}{self.captured:>10}  {self.stage:<18}{numbers}"


def run(way: str, folder: Path, out: Path, device: str, progress: Counting) -> None:
    """Run a way on a device, with as many patches and blocks at both sizes: at the sizes of captures their number is bounded."""
    with patch.object(interreflection, "PATCHES", PATCHES), patch.object(bounce_evidence, "BLOCKS", PATCHES):
        WAYS[way].run(folder, out, device, progress)


def count(way: str, side: int, captured: int, folder: Path, out: Path, device: str) -> list[Row]:
    """Run a way on a device, and return the rows of its stages, which only the emulated device counts."""
    progress = Counting()
    run(way, folder, out, device, progress)
    return [Row(way, side, captured, stage, tuple(counted[name] for name in emulated_device.COUNTED))
            for stage, counted in progress.close().items()]


def read() -> list[Row]:
    """Return the rows of the table."""
    found = []
    for line in TABLE.read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            way, side, captured, stage, *counts = line[:18], line[18:22], line[22:32], line[34:52], *line[52:].split()
            found.append(Row(way.strip(), int(side), int(captured), stage.strip(), tuple(map(int, counts))))
    return found


def main() -> None:
    """Write the table."""
    devices.names()
    emulated_device.install()
    lines = ["# What each stage of a product asks of the device (python -m tests.device_ways writes this):",
             "# product, pixels along the shorter side, bytes captured, stage, and then", *(
                 f"# {name}: {meaning}" for name, meaning in emulated_device.COUNTED.items())]
    for side in SIDES:
        for name, way in WAYS.items():
            with tempfile.TemporaryDirectory() as place:
                folder = Path(place)
                lines += map(str, count(name, side, way.write(folder, side), folder, folder / "out", emulated_device.NAME))
                print(*lines[-4:], sep="\n", flush=True)
    TABLE.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
