"""Two machines that share nothing but PostgreSQL and an object store: their folders are separate, and every connection goes through a proxy
that cuts it, in the middle of an upload, of a job and of a download."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from service.client import Client
from service.requests.jobs import RelightJob
from service.requests.keys import Scope
from service.requests.relight import RelightOptions
from tests.scenes.captures import make_scene, write_capture, write_exr
from tests.service.server.jobs.harness import digests, relit_relight
from tests.service.server.storage.conftest import s3, s3_server  # noqa: F401  (fixtures)
from tests.service.server.tcp_proxy import tcp_proxy
from tests.service.server_process import SABOTAGE, environment_with, serving

FRAMES, SIZE = 24, 128


@pytest.mark.long
def test_cut_connections_lose_nothing_between_machines_that_share_no_folder(tmp_path: Path, server_postgres, s3, monkeypatch):  # noqa: F811
    capture = write_capture(tmp_path / "capture", make_scene(size=SIZE, lights=6))
    sky = write_exr(tmp_path / "sky.exr", np.random.default_rng(7).random((16, 32, 3)))
    expected = relit_relight(capture, sky, FRAMES, tmp_path / "expected")
    database_url, store = server_postgres.new_database(), urlsplit(os.environ["AWS_ENDPOINT_URL"])
    shared = {"storage_url": s3, "min_free_bytes": "0", "chunk_frames": "4", "takeover_s": "0.5"}
    with (tcp_proxy(urlsplit(database_url).port) as to_database, tcp_proxy(store.port) as to_store,
          serving(tmp_path / "api", "--device", "none", database_url=database_url, **shared) as server,
          tcp_proxy(urlsplit(server.url).port) as to_api):
        key = server.key(scope=Scope.WRITE)
        environment = environment_with(
            **shared, database_url=database_url.replace(f":{urlsplit(database_url).port}/", f":{to_database.port}/")) | {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{to_store.port}", "PYTHONPATH": SABOTAGE, "SABOTAGE": "slow"}
        with open(tmp_path / "worker.log", "wb") as log:
            worker = subprocess.Popen([sys.executable, "-m", "service.cli.main", "worker", "--device", "cpu", "--data",
                                       str(tmp_path / "worker")], env=environment, stdout=log, stderr=log, start_new_session=True)
        try:
            with Client(f"http://127.0.0.1:{to_api.port}", key) as client:
                size = sum(path.stat().st_size for path in capture.rglob("*") if path.is_file())
                to_api.cut_after(size // 2)
                uploaded = client.captures.upload(capture)
                assert to_api.cuts == 1 and uploaded.state == "ready"
                lit = client.environments.upload(sky)
                made = sum(path.stat().st_size for path in (tmp_path / "expected").rglob("*") if path.is_file())
                to_store.cut_after(made // 2, away_s=2.0)  # of what the worker reads of the capture and writes of the frames
                job = client.jobs.submit(RelightJob(kind="relight", capture=uploaded.id, environment=lit.id,
                                                    options=RelightOptions(frames=f"1-{FRAMES}", spin_degrees=360)))
                for view in client.jobs.follow(job.id):
                    done = 0 if view.progress is None or view.progress.stage != "frames" else view.progress.done
                    if done >= 12 and to_database.cuts == 0:
                        to_database.cut_when_open(away_s=2.0)
                ended = client.jobs.get(job.id)
                assert (ended.state, ended.error) == ("succeeded", None), (tmp_path / "worker.log").read_text()[-4000:]
                assert to_database.cuts == 1 and to_store.cuts == 1
                total = sum(result.size for result in client.jobs.results(job.id))
                to_api.cut_after(total // 2)
                client.jobs.download(job.id, tmp_path / "fetched")
                assert to_api.cuts == 2
            assert digests(tmp_path / "fetched") == expected
            assert not list((tmp_path / "api").rglob("frame.*.part"))
            assert b"worker died" not in (tmp_path / "worker.log").read_bytes()
        finally:
            os.killpg(worker.pid, signal.SIGKILL)
            worker.wait()
