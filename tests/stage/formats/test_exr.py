"""EXR files, whole and some rows at a time."""

import itertools
import struct
from fractions import Fraction

import numpy as np
import OpenEXR
import pytest

from stage.errors import ImageError, StorageError
from stage.formats import exr, exr_rows, exr_scan
from stage.formats.exr_scan import CHECKSUM_ATTRIBUTE, is_intact, write_checksum
from tests.scenes.captures import files_in, write_exr

PIXELS = np.random.default_rng(3).random((37, 23, 3)).astype(np.float32)
"""Rows that fill no chunk of any compression evenly."""

TILED = {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
TILED["tiles"].xSize = TILED["tiles"].ySize = 16
ROWS, COLS = 150, 37
RGB = dict(zip("RGB", np.random.default_rng(5).random((3, ROWS, COLS)).astype(np.float16), strict=True))
DATA = {"depth.Z": np.random.default_rng(6).random((ROWS, COLS)).astype(np.float32)}
METADATA = {"relit:capture": "owl", "pixelAspectRatio": 1.5, "note": "dataWindow"}
ROW_COMPRESSIONS = [exr.Compression.ZIP, exr.Compression.PIZ, exr.Compression.DWAA]


def test_channels_keep_their_bits_and_types(tmp_path):
    path = tmp_path / "a.exr"
    channels = {"normal.X": PIXELS[..., 0], "mask.Y": PIXELS[..., 1].astype(np.float16)}
    exr.write(path, channels, color_space="lin_rec709_scene", metadata={"relit:capture": "öwl", "relit:options": "{}"})
    back, metadata = exr.read(path)
    assert set(back) == set(channels)
    for name, plane in channels.items():
        assert back[name].dtype == plane.dtype
        assert np.array_equal(back[name], plane)
    assert metadata["relit:capture"] == "öwl" and metadata["relit:options"] == "{}"
    assert exr.color_space_of(metadata) == "lin_rec709_scene"


@pytest.mark.parametrize(("space", "red"), [("lin_rec709_scene", (0.64, 0.33)), ("lin_ap1_scene", (0.713, 0.293))])
def test_the_colour_space_is_named_and_given_as_chromaticities(tmp_path, space, red):
    exr.write(tmp_path / "a.exr", {"Y": PIXELS[..., 0]}, color_space=space, metadata={})
    metadata = exr.read_header(tmp_path / "a.exr").metadata
    assert exr.color_space_of(metadata) == space
    assert np.allclose(metadata["chromaticities"][:2], red, atol=1e-6)


def test_a_header_without_a_colour_space_means_rec709():
    assert exr.color_space_of({}) == "lin_rec709_scene"
    assert exr.color_space_of({}, "lin_ap1_scene") == "lin_ap1_scene"


@pytest.mark.parametrize(("first", "count"), [
    ((5, 3), (20, 8)), ((-4, -6), (37, 23)), ((-2, 4), (45, 30)), ((30, 20), (9, 7)), ((50, 50), (4, 4)), ((-9, -9), (5, 5))])
@pytest.mark.parametrize("corner", [(0, 0), (100, -7)])
def test_pixels_stand_where_the_display_window_has_them(tmp_path, first, count, corner):
    """Files that store a part of the picture, as autocropped ones do, or more than it; a crop of an environment map was taken for all of
    it. Truth: every stored pixel put in its place by itself."""
    plane = np.random.default_rng(7).random(count).astype(np.float32)
    windows = [(np.array([a[1], a[0]], np.int32), np.array([a[1] + n[1] - 1, a[0] + n[0] - 1], np.int32)) for a, n in (
        ((first[0] + corner[0], first[1] + corner[1]), count), (corner, (37, 23)))]
    OpenEXR.File({"dataWindow": windows[0], "displayWindow": windows[1]}, {"Y": plane}).write(str(tmp_path / "a.exr"))
    truth = np.zeros((37, 23), np.float32)
    for row, col in itertools.product(*map(range, count)):
        if 0 <= row + first[0] < 37 and 0 <= col + first[1] < 23:
            truth[row + first[0], col + first[1]] = plane[row, col]
    header = exr.read_header(tmp_path / "a.exr")
    assert (header.height, header.width) == (37, 23) and np.array_equal(exr.read(tmp_path / "a.exr")[0]["Y"], truth)


def test_dwa_is_close_and_smaller(tmp_path):
    smooth = {"Y": np.linspace(0, 1, 64 * 64, dtype=np.float32).reshape(64, 64).astype(np.float16)}
    exr.write(tmp_path / "a.exr", smooth, color_space="lin_rec709_scene", metadata={}, compression=exr.Compression.DWAA)
    back, _ = exr.read(tmp_path / "a.exr")
    assert np.abs(back["Y"].astype(np.float32) - smooth["Y"]).max() < 0.02  # lossy by its nature
    assert (tmp_path / "a.exr").stat().st_size < smooth["Y"].nbytes
    assert exr.read_header(tmp_path / "a.exr").metadata["dwaCompressionLevel"] == exr.DWA_LEVEL


def test_dwa_keeps_the_channels_that_it_does_not_know(tmp_path):
    ramp = np.linspace(0, 1, 64 * 64, dtype=np.float32).reshape(64, 64).astype(np.float16)
    normal = {f"normal.{name}": ramp for name in "XYZ"}
    exr.write(tmp_path / "a.exr", normal, color_space="lin_rec709_scene", metadata={}, compression=exr.Compression.DWAA)
    back, _ = exr.read(tmp_path / "a.exr")
    same = {name: np.array_equal(back[name], plane) for name, plane in normal.items()}
    assert same == {"normal.X": True, "normal.Y": False, "normal.Z": True}  # Y is luminance to it


@pytest.mark.parametrize("entry", [b"\0" * 8, b"\xff" * 8, b"\1" + b"\0" * 7], ids=["zero", "huge", "inside the header"])
@pytest.mark.parametrize("tiled", [False, True])
def test_a_table_of_offsets_that_leads_nowhere_is_a_truncated_file(tmp_path, capfd, entry, tiled):
    """The table is written last: a writer that died leaves zeros."""
    path = write_exr(tmp_path / "a.exr", PIXELS, **(TILED if tiled else {}))
    data = bytearray(path.read_bytes())
    chunks = 3 * 2 if tiled else 3  # 37 rows and 23 columns in 16s
    # the first chunk lies right behind the table, which names it first
    table = next(i for i in range(len(data)) if struct.unpack_from("<Q", data, i)[0] == i + 8 * chunks)
    data[table : table + 8] = entry
    path.write_bytes(data)
    with pytest.raises(ImageError, match=r"a\.exr: is truncated: \d+ or more bytes are missing"):
        exr.read(path)
    assert capfd.readouterr().err == ""


def test_a_short_tiled_file_is_one_quiet_error(tmp_path, capfd):
    path = write_exr(tmp_path / "a.exr", PIXELS, **TILED)
    channels, _ = exr.read(path)
    assert np.array_equal(channels["R"], PIXELS[..., 0])
    data = path.read_bytes()
    for lost in (1, 200, len(data) // 2):
        path.write_bytes(data[:-lost])
        with pytest.raises(ImageError, match=r"a\.exr: is truncated"):
            exr.read(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("content", [b"", b"PNG", b"\x76\x2f\x31\x01", b"\x76\x2f\x31\x01\x02\x00\x00\x00" + b"\x00" * 50])
def test_what_is_no_exr_is_named(tmp_path, content):
    (tmp_path / "a.exr").write_bytes(content)
    with pytest.raises(ImageError, match=r"a\.exr: is (not an OpenEXR file|damaged or truncated)"):
        exr.read_header(tmp_path / "a.exr")


@pytest.mark.parametrize(("channels", "rows", "words"), [
    ("YY", (36, 36), "has several parts with a channel Y: give an image"), ("YZ", (36, 9), "has parts with different data windows")])
def test_parts_that_are_no_image_are_refused(tmp_path, channels, rows, words):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    windows = [(np.array([0, 0], np.int32), np.array([22, row], np.int32)) for row in rows]
    parts = [OpenEXR.Part({**header, "dataWindow": window, "displayWindow": windows[0]}, {name: PIXELS[: window[1][1] + 1, :, 0]}, part)
             for window, name, part in zip(windows, channels, ("left", "right"), strict=True)]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    with pytest.raises(ImageError, match=rf"a\.exr: {words}"):
        exr.read_header(tmp_path / "a.exr")


def parts_file(path):
    """A lossy picture and two parts of data, one of them in float."""
    colour = {name: PIXELS[..., 0].astype(np.float16) for name in "RGB"}
    exr.write_parts(path, [
        exr.Part("rgba", colour, "lin_ap1_scene", exr.Compression.DWAA),
        exr.Part("mask", {"mask.Y": PIXELS[..., 1].astype(np.float16)}, exr.DATA),
        exr.Part("P", {f"P.{name}": PIXELS[..., 2] * 3 for name in "XYZ"}, exr.DATA),
    ], metadata={"relit:capture": "öwl", "framesPerSecond": Fraction(24000, 1001), "pixelAspectRatio": 2.0})
    return path


def test_data_parts_are_lossless_beside_a_lossy_picture_and_are_no_colours(tmp_path):
    path = parts_file(tmp_path / "a.exr")
    channels, metadata = exr.read(path)
    assert np.array_equal(channels["mask.Y"], PIXELS[..., 1].astype(np.float16)) and channels["P.Y"].dtype == np.float32
    assert np.array_equal(channels["P.Y"], PIXELS[..., 2] * 3)
    assert not np.array_equal(channels["R"], PIXELS[..., 0].astype(np.float16))  # noise, of which DWAA loses a lot
    assert metadata["relit:capture"] == "öwl" and metadata["framesPerSecond"] == Fraction(24000, 1001)
    assert exr.color_space_of(metadata) == "lin_ap1_scene"
    with OpenEXR.File(str(path)) as file:
        assert [part.name() for part in file.parts] == ["rgba", "mask", "P"]
        for part in file.parts[1:]:
            assert part.header["colorInteropID"] == "data" and "chromaticities" not in part.header
            assert part.header["compression"] == OpenEXR.ZIP_COMPRESSION and part.header["pixelAspectRatio"] == 2


COMPRESSIONS = ["NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB"]


@pytest.mark.parametrize("name", [*COMPRESSIONS, "several parts"])
def test_every_shorter_file_is_known_as_truncated(tmp_path, capfd, name):
    whole = parts_file(tmp_path / "whole.exr") if name not in COMPRESSIONS else write_exr(
        tmp_path / "whole.exr", PIXELS, compression=getattr(OpenEXR, f"{name}_COMPRESSION"))
    data = whole.read_bytes()
    exr.read(whole)  # the whole one is fine
    cut = tmp_path / "cut.exr"
    rng = np.random.default_rng(5)
    for length in sorted({0, 3, 4, 8, 9, 50, 200, len(data) - 1, len(data) - 2, *rng.integers(0, len(data), 60).tolist()}):
        cut.write_bytes(data[:length])
        with pytest.raises(ImageError, match=r"cut\.exr: is") as caught:
            exr.read_header(cut)
        assert "\n" not in str(caught.value)
    out, err = capfd.readouterr()
    assert (out, err) == ("", "")  # OpenEXR prints its own lines while it decodes a short file


def test_missing_files_and_folders(tmp_path):
    with pytest.raises(StorageError, match=r"cannot read .*none\.exr: no such file"):
        exr.read_header(tmp_path / "none.exr")
    with pytest.raises(StorageError, match="is a directory"):
        exr.read_header(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot write"):
        exr.write(tmp_path / "file" / "a.exr", {"Y": PIXELS[..., 0]}, color_space="lin_rec709_scene", metadata={})


@pytest.mark.parametrize("space", exr.PRIMARIES)
def test_chromaticities_name_a_space_where_nothing_else_does(tmp_path, space):
    """Files of programs that write no colorInteropID; what they round to three digits is known all the same."""
    primaries = tuple(round(value, 3) for value in OpenEXR.colorInteropIDToChromaticities(space))
    path = write_exr(tmp_path / "a.exr", PIXELS, chromaticities=primaries)
    assert exr.color_space_of(exr.read_header(path).metadata) == space
    assert exr.color_space_of({"chromaticities": primaries, "colorInteropID": "lin_ap0_scene"}) == "lin_ap0_scene"


@pytest.mark.parametrize(("attributes", "space"), [
    ({"oiio:ColorSpace": "ACEScg"}, "lin_ap1_scene"), ({"oiio:ColorSpace": "Linear"}, "lin_rec709_scene"),
    ({"colorInteropID": "unknown", "oiio:ColorSpace": "lin_ap0"}, "lin_ap0_scene"), ({"colorInteropID": "data"}, "lin_rec709_scene")])
def test_spaces_are_declared_in_other_words(tmp_path, attributes, space):
    path = write_exr(tmp_path / "a.exr", PIXELS, **attributes)
    assert exr.color_space_of(exr.read_header(path).metadata) == space


def test_chromaticities_of_no_space_are_refused():
    with pytest.raises(ValueError, match="no known colour space"):
        exr.color_space_of({"chromaticities": (0.7, 0.3, 0.2, 0.7, 0.15, 0.05, 0.3, 0.3)})


@pytest.fixture
def no_threads():
    """The library without threads of its own, as a process starts."""
    OpenEXR.set_global_thread_count(0)
    yield
    OpenEXR.set_global_thread_count(0)


@pytest.mark.parametrize("compression", ["ZIP", "PIZ", "DWAA"])
def test_threads_of_the_library_write_and_read_the_same_bytes(tmp_path, monkeypatch, no_threads, compression):
    """A large image starts them, a small one does not."""
    rng = np.random.default_rng(5)
    channels = {name: rng.normal(1, 0.1, (300, 70)).astype(np.float16) for name in "RGB"}
    for name in ("alone.exr", "threads.exr"):
        exr.write(tmp_path / name, channels, color_space="data", metadata={}, compression=getattr(exr.Compression, compression))
        alone, _ = exr.read(tmp_path / "alone.exr")
        assert (OpenEXR.global_thread_count() > 0) == (name == "threads.exr")
        monkeypatch.setattr(exr, "LARGE_VALUES", 300 * 70 * 3)
    assert (tmp_path / "threads.exr").read_bytes() == (tmp_path / "alone.exr").read_bytes()
    found, _ = exr.read(tmp_path / "threads.exr")
    assert all(np.array_equal(found[name], alone[name]) for name in channels)


@pytest.mark.parametrize("threads", [False, True])
def test_damaged_pixels_are_one_error(tmp_path, monkeypatch, no_threads, threads):
    if threads:
        monkeypatch.setattr(exr, "LARGE_VALUES", 1)
    path = write_exr(tmp_path / "a.exr", np.zeros((64, 64, 3)) + np.arange(64)[:, None])  # smooth: kept packed
    data = bytearray(path.read_bytes())
    data[-60:-20] = b"\x55" * 40
    path.write_bytes(data)
    with pytest.raises(ImageError, match=r"a\.exr: cannot be decoded: its data is damaged"):
        exr.read(path)
    assert (OpenEXR.global_thread_count() > 0) == threads


PARTS = [exr.Part(name, {f"{name}.{channel}": np.arange(30, dtype=np.float16).reshape(5, 6) for channel in "RGB"}, "lin_rec709_scene")
         for name in ("one", "two")]


@pytest.mark.long
@pytest.mark.parametrize("parts", [PARTS[:1], PARTS])
def test_every_flipped_bit_is_found(tmp_path, parts):
    path = tmp_path / "a.exr"
    exr.write_parts(path, parts, metadata={"relit:capture": "owl"}, checksum=True)
    assert is_intact(path)
    channels, metadata = exr.read(path)
    assert len(channels) == 3 * len(parts) and len(metadata[CHECKSUM_ATTRIBUTE]) == 32  # and other readers do not mind it
    whole = path.read_bytes()
    for place in range(len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << place % 8]) + whole[place + 1 :])
        assert not is_intact(path), place
    for other in (whole[:-1], whole + b"\0", b"", whole[: whole.index(CHECKSUM_ATTRIBUTE.encode()) + 30]):
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


def cut(parts, first, last):
    return [part._replace(channels={name: plane[first:last] for name, plane in part.channels.items()}) for part in parts]


def write_in_blocks(path, parts, edges, **options):
    with exr_rows.growing(path, rows=ROWS, metadata=METADATA, **options) as file:
        for first, last in itertools.pairwise(edges):
            file.append(cut(parts, first, last))


@pytest.mark.parametrize("compression", ROW_COMPRESSIONS)
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
    assert own.keys() - header.keys() == {CHECKSUM_ATTRIBUTE}
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
