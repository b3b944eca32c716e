"""The checksum in the header of an EXR file: any other byte, and any byte more or less, is found."""

import numpy as np
import pytest

from stage.errors import StorageError
from stage.formats import exr
from stage.formats.exr_checksum import ATTRIBUTE, is_intact, write_checksum

PARTS = [exr.Part(name, {f"{name}.{channel}": np.arange(30, dtype=np.float16).reshape(5, 6) for channel in "RGB"}, "lin_rec709_scene")
         for name in ("one", "two")]


@pytest.mark.long
@pytest.mark.parametrize("parts", [PARTS[:1], PARTS])
def test_every_flipped_bit_is_found(tmp_path, parts):
    path = tmp_path / "a.exr"
    exr.write_parts(path, parts, metadata={"relit:capture": "owl"}, checksum=True)
    assert is_intact(path)
    channels, metadata = exr.read(path)
    assert len(channels) == 3 * len(parts) and len(metadata[ATTRIBUTE]) == 32  # and other readers do not mind it
    whole = path.read_bytes()
    for place in range(len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << place % 8]) + whole[place + 1 :])
        assert not is_intact(path), place
    for other in (whole[:-1], whole + b"\0", b"", whole[: whole.index(ATTRIBUTE.encode()) + 30]):
        path.write_bytes(other)
        assert not is_intact(path)
    path.write_bytes(whole)
    assert is_intact(path)


def test_equal_content_has_equal_bytes(tmp_path):
    for name in ("a.exr", "b.exr"):
        exr.write_parts(tmp_path / name, PARTS, metadata={}, checksum=True)
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


def test_a_file_without_the_attribute_takes_none(tmp_path):
    path = tmp_path / "a.exr"
    exr.write_parts(path, PARTS, metadata={})
    assert not is_intact(path)
    with pytest.raises(StorageError, match="has no relit:checksum"):
        write_checksum(path)
