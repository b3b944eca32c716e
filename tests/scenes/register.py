"""Scans of figures on a turntable in memory, their registration without a disk, and the fusion of scan sets."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from service.requests.register import FuseRequest
from service.scans.fusion.fuse import FuseResult, fuse
from service.scans.points.rigid import inverse, step_between
from service.scans.points.scan import Scan
from service.scans.registration.candidates import Outline, outline_of
from service.scans.registration.covariance import rows_of
from service.scans.registration.extent import extent_of
from service.scans.registration.pair_tasks import PairTask, register_pair
from service.scans.registration.pairs import Pair, prepare
from service.scans.registration.registration import Advance, Registration, RegistrationOptions, register_by
from stage.sets.scan_set import Turntable
from tests.scenes.turntable import MM, Distance, View, pose, see


class InMemory:
    """Scans in memory, and threads that register pairs of them."""

    def __init__(self, scans: Sequence[Scan], pool: ThreadPoolExecutor) -> None:
        self.scan, self.rows, self._pool = scans.__getitem__, rows_of, pool

    def outlines(self, cells: dict[int, float], advance: Advance) -> dict[int, Outline]:
        self._ready = dict(zip(cells, self._pool.map(lambda number: prepare(self.scan(number), cell_m=cells[number]), cells), strict=True))
        self.ready = self._ready.__getitem__
        return {number: outline_of(ready, cells[number]) for number, ready in self._ready.items()}

    def pairs(self, tasks: Sequence[PairTask], cells: dict[int, float], least_overlap: float, advance: Advance) -> list[Pair]:
        return [*self._pool.map(lambda task: register_pair(task, self._ready[task.a], self._ready[task.b],
                                                           cell_m=(cells[task.a], cells[task.b]), least_overlap=least_overlap), tasks)]


def register(scans: Sequence[Scan], starts: Sequence[np.ndarray | None] | None = None, *, table: Turntable | None = None,
             threads: int = 2, **options: bool) -> Registration:
    """Find the poses of scans of one object; arguments as of `register_by` and its options."""
    with ThreadPoolExecutor(threads) as pool:
        return register_by(InMemory(scans, pool), [scan.name for scan in scans], [extent_of(scan) for scan in scans],
                           starts or [None] * len(scans), RegistrationOptions(**options), table=table,
                           targets={number: scan.targets for number, scan in enumerate(scans)})


def fuse_scans(file: Path, out: Path, **options: Any) -> FuseResult:
    """What relit fuse makes of a scan set, without a texture."""
    return fuse(FuseRequest(scan_set=file, out=out, **{"texture": False, "device": "cpu", **options}))


def scan_with(points: np.ndarray, sigma: np.ndarray | float, *, name: str = "scan", **known: Any) -> Scan:
    """A scan of which nothing is known but its points, their deviations and what is given; from the origin."""
    return Scan(**{**dict.fromkeys(field.name for field in fields(Scan)), "name": name, "path": Path("scan"), "points": points,
                   "sigma": np.full(len(points), sigma, np.float32), "sigma_source": "measured",
                   "origin": np.zeros(3), "targets": (), **known})


def scan_of(view: View, *, points_only: bool = False) -> Scan:
    """What a scanner at a view gives, as it is read."""
    camera, pixels = view.camera, np.flatnonzero(view.mask)
    x, y = camera.plane_coordinates()
    sigma = view.sigma.reshape(-1)[pixels] * np.sqrt(1 + x**2 + y**2).reshape(-1)[pixels]
    known = {} if points_only else {"camera": camera, "pixels": pixels}
    return scan_with(camera.points(-view.depth).reshape(-1, 3)[pixels], sigma, name=f"at {view.world_from_scan[0, 0]:.3f}", **known)


def seen(surface: Distance, *angles: float, rows: int = 120, sigma: float = 0.25 * MM, trial: int = 0) -> list[View]:
    """Views of a surface that turns by these angles in degrees; `trial` numbers the draws of the noise."""
    return [see(surface, pose(angle), rows=rows, sigma=sigma, seed=1000 * trial + k) for k, angle in enumerate(angles)]


def off(views: list[View], found: Registration) -> np.ndarray:
    """[scan, 6] motion from the true to the found pose of each scan, about the middle of the figure, against the reference."""
    world = found.poses[found.reference] @ inverse(views[found.reference].world_from_scan)
    return np.array([step_between(inverse(world) @ placed @ inverse(views[number].world_from_scan), np.zeros(3))
                     for number, placed in found.poses.items()])
