"""EXR files that are written some rows at a time: the same bytes as files written at once, and nothing where they are not finished."""

import itertools

import numpy as np
import pytest

from stage.errors import StorageError
from stage.formats import exr, exr_rows, exr_scan
from tests.scenes.captures import files_in

ROWS, COLS = 150, 37
RGB = dict(zip("RGB", np.random.default_rng(5).random((3, ROWS, COLS)).astype(np.float16), strict=True))
DATA = {"depth.Z": np.random.default_rng(6).random((ROWS, COLS)).astype(np.float32)}
METADATA = {"relit:capture": "owl", "pixelAspectRatio": 1.5, "note": "dataWindow"}
COMPRESSIONS = [exr.Compression.ZIP, exr.Compression.PIZ, exr.Compression.DWAA]


def cut(parts, first, last):
    return [part._replace(channels={name: plane[first:last] for name, plane in part.channels.items()}) for part in parts]


def write_in_blocks(path, parts, edges, **options):
    with exr_rows.growing(path, rows=ROWS, metadata=METADATA, **options) as file:
        for first, last in itertools.pairwise(edges):
            file.append(cut(parts, first, last))


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("edges", [(0, 150), (0, 32, 150), (0, 64, 96, 128, 150)])
@pytest.mark.parametrize("checksum", [False, True])
def test_a_file_written_in_blocks_has_the_same_bytes(tmp_path, compression, edges, checksum):
    parts = [exr.Part("rgba", RGB, "lin_rec709_scene", compression)]
    exr.write_parts(tmp_path / "whole.exr", parts, metadata=METADATA, checksum=checksum)
    write_in_blocks(tmp_path / "blocks.exr", parts, edges, checksum=checksum)
    assert (tmp_path / "blocks.exr").read_bytes() == (tmp_path / "whole.exr").read_bytes()


def test_parts_with_chunks_of_different_heights(tmp_path):
    parts = [exr.Part("rgba", RGB, "lin_rec709_scene", exr.Compression.DWAA), exr.Part("depth", DATA, exr.DATA)]
    exr.write_parts(tmp_path / "whole.exr", parts, metadata=METADATA)
    write_in_blocks(tmp_path / "blocks.exr", parts, (0, 64, 128, 150), checksum=True)
    assert exr_scan.is_intact(tmp_path / "blocks.exr")
    whole, header = exr.read(tmp_path / "whole.exr")
    found, own = exr.read(tmp_path / "blocks.exr")
    assert own.keys() - header.keys() == {exr_scan.CHECKSUM_ATTRIBUTE}
    assert {name: own[name] for name in header if name != "channels"}["note"] == "dataWindow"
    assert whole.keys() == found.keys()
    assert all(np.array_equal(plane, found[name]) for name, plane in whole.items())


def test_an_unfinished_file_is_not_there(tmp_path):
    parts = [exr.Part("", RGB, "lin_rec709_scene")]
    with pytest.raises(ValueError, match="86 of 150 rows are missing"):
        write_in_blocks(tmp_path / "a.exr", parts, (0, 64))
    with pytest.raises(ValueError, match="40 rows after 0 of 150"):
        write_in_blocks(tmp_path / "a.exr", parts, (0, 40, 150))
    assert files_in(tmp_path) == set()


def test_a_folder_that_is_no_folder_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match=r"a\.exr"):
        write_in_blocks(tmp_path / "file" / "a.exr", [exr.Part("", RGB, "lin_rec709_scene")], (0, 150))
