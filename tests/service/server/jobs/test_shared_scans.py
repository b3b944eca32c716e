"""Registration and fusion of scans by several workers: the same results as those of one process, whoever is killed."""

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest

from service.requests.identifiers import JOB, new_id
from service.requests.jobs import RegisterJob
from service.requests.register import RegisterRequest
from service.scans.register import register_scans
from service.server.database import jobs
from service.server.storage import layout
from stage.depth_maps import DepthMaps
from stage.scans.records import ScanEntry, ScanSet, read_scan_set, write_scan_set
from tests.scenes.turntable import View, figure
from tests.service.server.jobs.harness import PROJECT, Harness, harness
from tests.service.server.jobs.test_faults import SABOTAGE
from tests.service.server.jobs.test_sharing import WORKERS, begun, both_at_work, pieces_folder
from tests.stage.scans.test_registration import seen


@pytest.fixture(scope="module")
def views() -> list[View]:
    return seen(figure, *range(0, 150, 30), rows=120)


def put_depths(made: Harness, views: list[View]) -> list[str]:
    """The results of depth jobs, of which the poses are known to 3 mm."""
    names = []
    rng = np.random.default_rng(3)
    for view in views:
        name = new_id(JOB)
        pose = view.world_from_scan.copy()
        pose[:3, 3] += rng.normal(scale=0.003, size=3)
        camera = view.camera.model_copy(update={"world_from_camera": tuple(tuple(map(float, row)) for row in pose)})
        DepthMaps(camera=camera, mask=view.mask, depth=view.depth, sigma=view.sigma).write(
            made.settings.data / layout.results(PROJECT, name) / "depth.exr")
        names.append(name)
    return names


def registered_alone(made: Harness, names: list[str], out: Path) -> Path:
    """What `relit register` makes of the same scans in one process."""
    folder = made.settings.data / layout.results(PROJECT, names[0])
    file = folder.parent / "scan-set.json"
    write_scan_set(ScanSet(schema="relit.scan-set/1", name="alone", scans=tuple(ScanEntry(name=name, path=name) for name in names)), file)
    return register_scans(RegisterRequest(scan_set=file, out=out, threads=1)).scan_set_path


def start(made: Harness) -> None:
    for _ in range(WORKERS):
        made.start(PYTHONPATH=SABOTAGE, PIECES="0", TOGETHER=str(made.folder / "together"))
    made.ready(WORKERS)


def poses_of(path: Path) -> list[object]:
    return [(scan.name, scan.scan_to_world, scan.pose_covariance) for scan in read_scan_set(path)[1].scans]


def test_two_workers_find_the_same_poses_as_one_process(tmp_path, views):
    with harness(tmp_path / "service", log_level="debug") as made:
        names = put_depths(made, views)
        alone = registered_alone(made, names, tmp_path / "alone")
        start(made)
        job = made.submit(RegisterJob(kind="register", depths=tuple(names)), chunk_frames=8)
        row = made.ended(job)
        assert (row["state"], row["error"], row["lost"]) == (jobs.SUCCEEDED, None, 0)
        shares = begun(made, job)
        assert len(shares) == WORKERS
        pieces = [piece for share in shares.values() for piece in share]
        assert len(pieces) - len(set(pieces)) <= len(set(pieces)) // 4  # two that claim one at the same moment both do it
        assert poses_of(made.results(job) / "scan-set.json") == poses_of(alone)
        assert json.loads((made.results(job) / "report.json").read_text())["pairs"] == json.loads(
            (alone.parent / "report.json").read_text())["pairs"]
        assert not pieces_folder(made, job).exists()


@pytest.mark.long
def test_the_scans_and_pairs_of_a_killed_worker_are_done_by_another(tmp_path, views):
    with harness(tmp_path / "service", log_level="debug", takeover_s=0.5) as made:
        names = put_depths(made, views)
        alone = registered_alone(made, names, tmp_path / "alone")
        start(made)
        job = made.submit(RegisterJob(kind="register", depths=tuple(names)), chunk_frames=8)
        holder, _ = both_at_work(made, job)
        os.kill(made.pid_of(holder), signal.SIGKILL)
        row = made.ended(job)
        assert (row["state"], row["error"]) == (jobs.SUCCEEDED, None) and row["worker"] != holder
        assert poses_of(made.results(job) / "scan-set.json") == poses_of(alone)
        assert not pieces_folder(made, job).exists()
