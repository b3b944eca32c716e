"""Captures whose program is killed go on where they were."""

import multiprocessing
import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from service.cli.main import main
from tests.scenes.captures import rgb
from tests.scenes.patched_rigs import write_plan
from tests.service.acquisition.test_acquire import LAMPS, Stage, check, controller, posting, request
from tests.service.waiting import until


def be_the_program(words: list[str], said: Path) -> None:
    """Run `relit` in this process, with its output in a file."""
    with said.open("w") as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    sys.argv = ["relit", *words]
    main()


@pytest.mark.long
def test_a_capture_goes_on_after_sigkill_at_random_moments(tmp_path):
    stage, rounds, most = Stage(tmp_path / "watch"), 5, 3
    write_plan(tmp_path, {"take": "dark"}, *[{"take": "olat"}] * rounds)
    with controller(tmp_path, stage) as (rig, url):
        given = request(tmp_path, stage, rig, trigger=posting(f"{url}/shoot"), timeout=10)
        words = ["capture", given.plan, "--rig", str(rig), "--camera", given.camera, "--out", str(given.out), "--trigger", given.trigger,
                 "--timeout", "10"]
        random, processes = np.random.default_rng(2), multiprocessing.get_context("forkserver")  # which loads all modules once
        processes.set_forkserver_preload(["service.cli.commands.acquire", "service.acquisition.acquire", "service.acquisition.early_ingest",
                                          "service.acquisition.cameras.watched_folder", "service.acquisition.lights.http_requests"])
        for _ in range(10):
            wanted = stage.released + int(random.integers(1, most + 1))  # the first shows that nothing moved
            program = processes.Process(target=be_the_program, args=[words, tmp_path / "said.txt"])
            program.start()
            until(lambda program=program, wanted=wanted: stage.released >= wanted or not program.is_alive(), "no picture", every_s=0.001)
            time.sleep(random.uniform(0, 0.1))
            assert program.is_alive(), f"the capture ended before it was killed: {(tmp_path / 'said.txt').read_text()}"
            program.kill()
            program.join()
        last = processes.Process(target=be_the_program, args=[words, tmp_path / "said.txt"])
        last.start()
        last.join()
        assert last.exitcode == 0, (tmp_path / "said.txt").read_text()
    assert stage.on == set()
    check(tmp_path / "capture", stage, rounds=rounds)
    assert not list((tmp_path / "capture").glob(".*.exr"))  # half-written when it was killed
    seen = [rgb(path) for path in sorted((tmp_path / "capture").glob("*_light_*.exr"))]  # and each picture is that of its lamp
    assert [np.abs(0.2 * stage.scene.images - each).mean(axis=(1, 2, 3)).argmin() for each in seen] == rounds * list(range(LAMPS))
