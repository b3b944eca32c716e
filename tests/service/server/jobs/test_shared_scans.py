"""Registration and fusion of scans by several workers: the same results as those of one process, whoever is killed."""

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from service.requests.base.identifiers import JOB, new_id
from service.requests.jobs import FuseJob, RegisterJob
from service.requests.register import FuseOptions, FuseRequest, RegisterRequest
from service.scans.fusion.fuse import fuse
from service.scans.register import register_scans
from service.server.database import jobs
from service.server.storage import layout
from stage.results.depth_maps import DepthMaps
from stage.sets.scan_set import ScanEntry, ScanSet, read_scan_set, write_scan_set
from tests.scenes.register import seen
from tests.scenes.turntable import View, figure
from tests.service.server.jobs.harness import PROJECT, Harness, harness, no_pieces, shared
from tests.service.server.jobs.test_sharing import WORKERS, both_at_work
from tests.service.server_process import SABOTAGE

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def views() -> list[View]:
    return seen(figure, *range(0, 150, 30), rows=120)


def put_registered(made: Harness, names: list[str], views: list[View]) -> Path:
    """The results of a register job with the true poses."""
    folder = made.settings.data / layout.results(PROJECT, new_id(JOB))
    folder.mkdir(parents=True)
    for name in names:  # paths of a scan set are relative to it; the job finds depths by their names alone
        (folder / name).symlink_to(folder.parent / name)
    entries = tuple(ScanEntry(name=name, path=name, scan_to_world=tuple(tuple(map(float, row)) for row in view.world_from_scan))
                    for name, view in zip(names, views, strict=False))
    write_scan_set(ScanSet(schema="relit.scan-set/1", name="figure", scans=entries), folder / "scan-set.json")
    return folder


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Harness]:
    """A service with two workers, which serve one test after the other; the first piece of each job waits for both. In the last test one of
    them is killed."""
    with harness(tmp_path_factory.mktemp("service"), log_level="debug", takeover_s=0.5) as made:
        for _ in range(WORKERS):
            made.start(PYTHONPATH=SABOTAGE, PIECES="0", TOGETHER=str(made.folder / "together"))
        made.ready(WORKERS)
        yield made


@pytest.fixture(scope="module")
def depths(pair: Harness, views: list[View]) -> list[str]:
    """The results of depth jobs, of which the poses are known to 3 mm."""
    names = []
    rng = np.random.default_rng(3)
    for view in views:
        name = new_id(JOB)
        pose = view.world_from_scan.copy()
        pose[:3, 3] += rng.normal(scale=0.003, size=3)
        camera = view.camera.model_copy(update={"world_from_camera": tuple(tuple(map(float, row)) for row in pose)})
        DepthMaps(camera=camera, mask=view.mask, depth=view.depth, sigma=view.sigma).write(
            pair.settings.data / layout.results(PROJECT, name) / "depth.exr")
        names.append(name)
    return names


@pytest.fixture(scope="module")
def alone(pair: Harness, depths: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `relit register` makes of the same scans in one process."""
    file = pair.settings.data / layout.results(PROJECT, "scan-set.json")
    entries = tuple(ScanEntry(name=name, path=name) for name in depths)
    write_scan_set(ScanSet(schema="relit.scan-set/1", name="alone", scans=entries), file)
    return register_scans(RegisterRequest(scan_set=file, out=tmp_path_factory.mktemp("alone"), threads=1)).scan_set_path


def poses_of(path: Path) -> list[object]:
    return [(scan.name, scan.scan_to_world, scan.pose_covariance) for scan in read_scan_set(path)[1].scans]


def test_two_workers_find_the_same_poses_as_one_process(pair, depths, alone):
    job = pair.submit(RegisterJob(kind="register", depths=tuple(depths)), chunk_frames=8)
    shared(pair, job, WORKERS)
    assert poses_of(pair.results(job) / "scan-set.json") == poses_of(alone)
    assert json.loads((pair.results(job) / "report.json").read_text())["pairs"] == json.loads(
        (alone.parent / "report.json").read_text())["pairs"]


def test_two_workers_write_the_same_tiles_as_one_process(pair, depths, views, tmp_path):
    registered = put_registered(pair, depths[:4], views)
    options = {"tiles": True, "voxel_m": 6e-3}
    expected = fuse(FuseRequest(scan_set=registered, out=tmp_path / "alone", device="cpu", **options)).report_path.parent
    job = pair.submit(FuseJob(kind="fuse", registered=registered.name, options=FuseOptions(**options)), chunk_frames=8)
    shared(pair, job, WORKERS)
    tiles = {path.name: path.read_bytes() for path in (expected / "tiles").glob("*.ply")}
    assert len(tiles) > 1 and {path.name: path.read_bytes() for path in (pair.results(job) / "tiles").glob("*.ply")} == tiles
    assert (pair.results(job) / "site.usda").exists()


def test_the_scans_and_pairs_of_a_killed_worker_are_done_by_another(pair, depths, alone):
    job = pair.submit(RegisterJob(kind="register", depths=tuple(depths)), chunk_frames=8)
    holder, _ = both_at_work(pair, job)
    os.kill(pair.pid_of(holder), signal.SIGKILL)
    row = pair.ended(job)
    assert (row["state"], row["error"]) == (jobs.SUCCEEDED, None) and row["worker"] != holder
    assert poses_of(pair.results(job) / "scan-set.json") == poses_of(alone)
    no_pieces(pair, job)
