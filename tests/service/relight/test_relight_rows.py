"""Frames of images too large for a chunk of whole frames: they are written some rows at a time, and are the same files."""

import json

import numpy as np
import pytest

from service.relight import combine
from stage.errors import StorageError
from stage.formats import exr
from tests.scenes.captures import files_in, make_scene, write_capture, write_exr, write_image
from tests.service.relight.test_relight_only import digests

SIZE = 200
"""Rows of more than one block, the last of which is neither a multiple of a chunk nor of a pack."""
SCENE = make_scene(size=SIZE, lights=6)
KEY = {"frame": 1, "direction": [0, 3, 1], "irradiance": [1, 1, 3], "angle_degrees": 2}
KEYS = {"schema": "relit.keys/1", "lights": [{"name": "key", "keys": [KEY]}]}


@pytest.fixture
def run(relit, tmp_path):
    write_capture(tmp_path / "cap", SCENE)
    write_image(tmp_path / "cap" / "mask.png", (255 * np.random.default_rng(0).random((SIZE, SIZE))).astype(np.uint8))  # a soft matte
    write_exr(tmp_path / "sky.exr", np.random.default_rng(1).random((8, 16, 3)))
    (tmp_path / "keys.json").write_text(json.dumps(KEYS))

    def relight(folder, *options):
        return relit("relight", tmp_path / "cap", "--environment", tmp_path / "sky.exr", "--spin-degrees", "90", "--frames", "1-4",
                     "--out", tmp_path / folder / "a.#.exr", *options)

    return relight


@pytest.fixture
def large(monkeypatch):
    """Images count as too large for a chunk, and rows are cut into blocks of 64."""
    monkeypatch.setattr(combine, "CHUNK_BYTES", 1)
    monkeypatch.setattr(combine, "BLOCK_BYTES", 1)


@pytest.mark.long
@pytest.mark.parametrize("options", [
    (), ("--compression", "piz", "--exposure", "1", "--color-space", "lin_ap1_scene"), ("--compression", "dwaa"),
    ("--aov", "mask", "--matte", "soft"), ("--aov", "lights"),
], ids=["zip", "piz", "dwaa", "layers", "one light"])
def test_files_written_in_rows_are_those_written_whole(run, request, tmp_path, options):
    assert run("whole", *options).code == 0
    request.getfixturevalue("large")
    outcome = run("rows", *options, "--only", "2-4")
    assert (outcome.code, outcome.err) == (0, "")
    whole = digests(tmp_path / "whole")
    assert digests(tmp_path / "rows") == {name: whole[name] for name in ("a.2.exr", "a.3.exr", "a.4.exr")}
    assert "skipped  3 of 4" in run("rows", *options).out


@pytest.mark.long
def test_parts_and_several_lights(run, request, tmp_path):
    options = ("--keys", tmp_path / "keys.json", "--aov", "lights,mask", "--parts", "multi")
    assert run("whole", *options).code == 0
    request.getfixturevalue("large")
    assert run("rows", *options).code == 0
    for name in files_in(tmp_path / "whole"):
        (whole, _), (rows, _) = exr.read(tmp_path / "whole" / name), exr.read(tmp_path / "rows" / name)
        assert whole.keys() == rows.keys() and {"R", "light_key.R", "light_environment.R", "mask.Y"} <= whole.keys()
        assert all(np.array_equal(plane, rows[channel]) for channel, plane in whole.items())


def test_clipped_pixels_are_counted_in_all_blocks(run, request):
    clipped = [line for line in run("whole", "--exposure", "20").out.splitlines() if line.startswith("clipped")]
    request.getfixturevalue("large")
    assert clipped and clipped == [line for line in run("rows", "--exposure", "20").out.splitlines() if line.startswith("clipped")]


def test_a_fault_in_a_later_block_leaves_no_frame_of_the_chunk(run, large, tmp_path, monkeypatch):
    encode, calls = exr.encode, []

    def failing(temporary, parts, **options):
        calls.append(temporary)
        if len(calls) == 10:
            raise StorageError("no space left")
        encode(temporary, parts, **options)

    monkeypatch.setattr(exr, "encode", failing)
    outcome = run("rows")
    assert outcome.code == 2 and "no space left" in outcome.err
    assert files_in(tmp_path / "rows") == set()
