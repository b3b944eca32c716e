"""Boards as jobs: captures are the tiles of an uploaded folder, and a board is compared with the result of another job."""

import json
from pathlib import Path

import numpy as np
import pytest

from tests.scenes.board import write_depth
from tests.scenes.depth import BLACK_WHITE, gray_patterns, make_scene, phase_patterns, write_patterns
from tests.service.server.api.test_jobs import finish, made_by, refused, submit
from tests.service.server.api.test_measuring import upload


@pytest.fixture(scope="module")
def tile(tmp_path_factory) -> dict[str, bytes]:
    """A board of one tile: a tilted plane under Gray code and phase shifting."""
    folder = tmp_path_factory.mktemp("board")
    patterns = [*gray_patterns("column", stripe=8), *phase_patterns("column", 16.0), *BLACK_WHITE]
    write_patterns(folder / "tile", make_scene(sphere=False), patterns, noise=0.002)
    board = {"schema": "relit.board-scan/1", "name": "plane", "tiles": [{"path": "tile", "position_m": [0, 0]}]}
    (folder / "board.json").write_text(json.dumps(board))
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_board_is_compared_with_the_result_of_a_job(server, client, tile):
    """The same images pass against themselves but for what has no depth."""
    board = upload(server, client, tile)
    assert board["facts"]["tiles"] == 1
    golden = submit(client, kind="inspect-board", capture=board["id"])
    finish(server, client, golden)
    assert made_by(client, golden) == {"board.exr", "inspection.png", "report.json"}
    job = submit(client, kind="inspect-board", capture=board["id"], golden=golden["id"], options={"least_inspected": 0.5})
    finish(server, client, job)
    assert made_by(client, job) == {"board.exr", "deviation.exr", "findings.csv", "inspection.png", "report.json"}
    report = client.get(f"/v1/jobs/{job['id']}/results/report.json").json()
    assert report["comparison"]["verdict"] == "pass" and report["defects"] == []
    assert report["comparison"]["pixels"]["inspected"] > 1000
    assert str(server.data) not in json.dumps(report)
    depth = submit(client, kind="depth", capture=board["id"])
    assert "capture.json" in finish(server, client, depth, "failed")["error"]
    other = client.post("/v1/jobs", json={"kind": "inspect-board", "capture": board["id"], "golden": depth["id"]})
    refused(other, 422, "is a depth job: give one of inspect-board")


def test_boards_that_cannot_be(server, client, tile, tmp_path: Path):
    away = upload(server, client, tile | {"board.json": tile["board.json"].replace(b'"tile"', b'"../tile"')}, "refused")
    assert "leads out of the folder of the file" in away["problem"]
    empty = upload(server, client, {"board.json": tile["board.json"]}, "refused")
    assert "tile/capture.json is no file" in empty["problem"] and str(server.data) not in empty["problem"]
    write_depth(tmp_path / "depth.exr", np.zeros((20, 20)))
    depth = upload(server, client, tile | {"tile/depth.exr": (tmp_path / "depth.exr").read_bytes()}, "refused")
    assert "the service takes captures as tiles" in depth["problem"]
