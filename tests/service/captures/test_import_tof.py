"""Raw time-of-flight data in the layouts of sensors and programs: from files to true ranges in two commands."""

import json

import numpy as np
import pytest
from scipy.io import savemat

from stage.capture.capture import Capture
from stage.tof.raw_frames import read_correlations, read_histograms
from tests.scenes.captures import files_in

C = 299792458.0
ROWS, COLS = 24, 32
RANGE_M = 1.0 + 0.02 * np.arange(COLS) + 0.01 * np.arange(ROWS)[:, None]
"""[rows, cols] metres: a slope, within the first turn of 60 MHz."""
RNG = np.random.default_rng(4)


def correlations(frequencies, phases, sign=-1):
    """[frequencies · phases, rows, cols] of P + Q cos(φ ∓ δ), dark-subtracted and therefore signed."""
    return np.array([500 * np.cos(4 * np.pi * f * RANGE_M / C + sign * np.radians(d)) + RNG.normal(0, 1, RANGE_M.shape)
                     for f in frequencies for d in phases]).astype(np.float32)


def solve(relit, folder, *words):
    out = relit("import", *words).well()
    return relit.depth(folder).maps, out


def error(maps, truth=RANGE_M):
    """Metres, over the solved pixels."""
    assert maps.mask.mean() > 0.95
    return np.abs(maps.range - truth)[maps.mask]


SWEPT = 600 + correlations([60e6], [0, 90, 180, 270])
QUARTERS = ("--phases-deg", "0,90,180,270")


@pytest.mark.long
@pytest.mark.parametrize("layout", ["an array for each phase", "one array", "MATLAB", "MATLAB, one variable a phase", "raw", "NumPy"])
def test_one_frequency(relit, tmp_path, layout):
    images, words = correlations([60e6], [0, 90, 180, 270]), ["--signal", "minus"]
    (tmp_path / "raw").mkdir()
    if layout == "an array for each phase":
        for name, image in zip((0, 90, 180, 270), images, strict=True):  # natural order: 0, 90, 180, 270
            np.save(tmp_path / "raw" / f"phase{name}.npy", image)
        np.save(tmp_path / "raw" / "dist.npy", RANGE_M)
        words += ["--arrays", "phase*.npy"]
    elif layout == "one array":
        np.save(tmp_path / "raw" / "frames.npy", np.moveaxis(images, 0, -1))
    elif layout == "MATLAB":
        savemat(tmp_path / "raw" / "frames.mat", {"dcs": np.moveaxis(images, 0, -1), "f_mod": 60.0}, do_compression=True)
    elif layout == "MATLAB, one variable a phase":
        savemat(tmp_path / "raw" / "frames.mat", {f"A{n}": image for n, image in enumerate(images)})
        words += ["--variable", "A0,A1,A2,A3"]
    elif layout == "raw":
        (tmp_path / "raw" / "dcs.bin").write_bytes(np.rint(images).astype(">i2").tobytes())
        words += ["--dtype", ">i2", "--size", f"{COLS}x{ROWS}"]
    else:
        np.savez(tmp_path / "raw" / "frames.npz", dcs=images)
    words = ["tof", tmp_path / "raw", tmp_path / "capture", "--frequencies-hz", "60e6", *QUARTERS, *words]
    if layout in ("an array for each phase", "MATLAB"):
        maps, out = solve(relit, tmp_path / "capture", *words)
        assert np.median(error(maps)) < 0.002 and error(maps).max() < 0.01  # noise of 1 on an amplitude of 500
    else:
        out = relit("import", *words).out
    found = read_correlations(Capture.open(tmp_path / "capture"))
    assert np.array_equal(found.images, np.rint(images).reshape(4, -1) if layout == "raw" else images.reshape(4, -1))
    assert np.allclose(found.reference_phase_rad, np.radians([0, 90, 180, 270]))
    assert "60 MHz repeats after 2.498 m" in out and "P + Q cos(φ − δ)" in out


@pytest.mark.parametrize("order", ["frequency,phase", "phase,frequency"])
def test_two_frequencies_with_the_other_sign(relit, tmp_path, order):
    images = correlations([60e6, 50e6], [0, 120, 240], sign=1).reshape(2, 3, ROWS, COLS)
    np.save(tmp_path / "frames.npy", (images if order == "frequency,phase" else images.swapaxes(0, 1)).reshape(6, ROWS, COLS))
    maps, _ = solve(relit, tmp_path, "tof", tmp_path, "--frequencies-hz", "60e6,50e6", "--phases-deg", "0,120,240", "--signal", "plus",
                    "--order", order, "--focal-px", "400")
    assert error(maps).max() < 0.01 and Capture.open(tmp_path).camera.focal_px == (400, 400)


@pytest.mark.parametrize(("values", "words", "message"), [
    (np.zeros((4, 8, 3)), (), "frames.npy: is 4 x 8 x 3: say with --planes first or last"),
    (np.zeros((5, 8, 9)), ("--planes", "first"), "frames.npy hold 5 images, 1 frequencies of 4 phases are 4"),
    (np.zeros(7), (), "frames.npy: is 7 float64: give images of numbers"),
    (np.zeros((4, 8, 9), complex), (), "frames.npy"),
    (b"x" * 99, (), "dcs.bin: is raw numbers: give their --dtype"),
    (b"x" * 99, ("--dtype", "uint16", "--size", "4x4"), "bytes, which is no whole number of images of 4x4 uint16 (32"),
    (b"x" * 32, ("--dtype", "words", "--size", "4x4"), "--dtype words: is no type of numbers"),
    *((SWEPT.astype(kind).tobytes(), ("--dtype", told, "--size", f"{COLS}x{ROWS}"), f"give --dtype '{kind}'")
      for kind, told in ((">i2", "int16"), ("<u4", ">u4"), (">f4", "float32"))),
])
def test_faults_of_correlation_images(relit, tmp_path, values, words, message):
    if isinstance(values, bytes):
        (tmp_path / "dcs.bin").write_bytes(values)
    else:
        np.save(tmp_path / "frames.npy", values)
    before = files_in(tmp_path)
    relit("import", "tof", tmp_path, "--frequencies-hz", "6e7", *QUARTERS, "--signal", "minus", *words).refused(message)
    assert files_in(tmp_path) == before


BIN_S = 1e-10


def histograms(shape, scale=1):
    """Photons of a pulse of 2 bins and some background, at 0.5 m and on."""
    truth = 0.5 + 0.005 * np.arange(shape[0] * shape[1]).reshape(shape)
    time = (np.arange(128) + 0.5) * BIN_S
    mean = 400 * np.exp(-((time - 2 * truth[..., None] / C) ** 2) / (2 * (2 * BIN_S) ** 2)) / 5 + 0.5
    return truth, scale * RNG.poisson(mean).astype(np.int32)


@pytest.mark.long
@pytest.mark.parametrize("layout", ["npy", "bins first", "MATLAB", "JSON of a chip with 3x3 zones"])
def test_histograms(relit, tmp_path, layout):
    truth, counts = histograms((3, 3) if "JSON" in layout else (12, 16), scale=10 if layout == "npy" else 1)
    words = ["--bin-s", "1e-10"]
    if layout == "npy":
        np.save(tmp_path / "h.npy", counts)
        words += ["--count-scale", "10"]
    elif layout == "bins first":
        np.save(tmp_path / "h.npy", np.moveaxis(counts, -1, 0))
        words += ["--bins", "first"]
    elif layout == "MATLAB":
        savemat(tmp_path / "scene.mat", {"spad": {"transient": counts}, "bin_width": 1e-10})
        words += ["--variable", "spad.transient"]
    else:
        (tmp_path / "poses.json").write_text(json.dumps([{"dist": 0, "hists": counts.reshape(9, 128).tolist()}] * 2))
        words += ["--variable", "1.hists", "--size", "3x3"]
    if layout == "npy" or "JSON" in layout:
        maps, out = solve(relit, tmp_path, "histogram", tmp_path, *words)
        assert np.median(error(maps, truth)) < 0.005 and error(maps, truth).max() < 0.03  # 15 mm a bin; the pulse is not declared
    else:
        out = relit("import", "histogram", tmp_path, *words).out
    assert "0 to 1.919 m" in out and np.array_equal(read_histograms(Capture.open(tmp_path)).counts, counts.reshape(-1, 128))
    tof = Capture.open(tmp_path).manifest.frames[0].tof
    assert (tof.bin_s, tof.count_scale) == (BIN_S, 10 if layout == "npy" else None)


@pytest.mark.parametrize("retroreflectors", [0, 4])
def test_bins_along_the_first_axis_are_refused_unless_it_is_said(relit, tmp_path, retroreflectors):
    _, counts = histograms((20, 24))
    counts.reshape(480, 128)[:retroreflectors] *= 30
    np.save(tmp_path / "h.npy", np.moveaxis(counts, -1, 0))
    relit("import", "histogram", tmp_path, "--bin-s", "1e-10").refused("--bins first if bins are counted first")
    assert files_in(tmp_path) == {"h.npy"}
    relit("import", "histogram", tmp_path, "--bin-s", "1e-10", "--bins", "last").well()


@pytest.mark.parametrize("scene", ["lit floor", "dark"])
def test_bins_along_the_last_axis_are_believed(relit, tmp_path, scene):
    """A floor, each row of which is a pulse in bins of its own, under ambient light on half of the rows; and no return at all."""
    mean = np.full((64, 24, 128), 0.5)
    if scene == "lit floor":
        mean[:32] = 40
        mean[np.arange(64), :, 30 + np.arange(64)] += 200
    np.save(tmp_path / "h.npy", RNG.poisson(mean).astype(np.int32))
    assert "24x64 pixels of 128 bins" in relit("import", "histogram", tmp_path, "--bin-s", "1e-10").well()


@pytest.mark.parametrize(("values", "words", "message"), [
    (np.ones((9, 64), np.int32), (), "h.npy: has 9 histograms of 64 bins in a row: say with --size"),
    (np.ones((9, 64), np.int32), ("--size", "2x4"), "has 9 histograms of 64 bins in a row"),
    (np.ones((64, 9, 2), np.int32), (), "h.npy: has 2 bins: if they are counted first, say --bins"),
    (-np.ones((4, 4, 9)), (), "h.npy: holds counts that are negative or not finite"),
    ([{"hists": [[1, 2, 3]]}], (), "holds no array of numbers: say with --variable where it is"),
    ([{"hists": [[1, 2, 3]]}], ("--variable", "0.counts"), "there is no counts in the keys hists"),
    ([{"hists": [[1, 2, 3]]}], ("--variable", "3.hists"), "there is no 3 in a list of 1"),
])
def test_faults_of_histograms(relit, tmp_path, values, words, message):
    if isinstance(values, list):
        (tmp_path / "h.json").write_text(json.dumps(values))
    else:
        np.save(tmp_path / "h.npy", values)
    source, = tmp_path.iterdir()
    relit("import", "histogram", source if isinstance(values, list) else tmp_path, "--bin-s", "1e-10", *words).refused(message)
    assert files_in(tmp_path) == {source.name}


def test_megahertz_and_nanoseconds_in_place_of_hertz_and_seconds_are_refused(relit, tmp_path):
    (tmp_path / "cw").mkdir()
    np.save(tmp_path / "cw" / "frames.npy", np.ones((4, 8, 9)))
    relit("import", "tof", tmp_path / "cw", "--frequencies-hz", "20", *QUARTERS, "--signal", "minus", "--planes", "first").refused(
        "--frequencies-hz: 20 Hz repeats after 7.49e+06 m: give hertz")
    np.save(tmp_path / "h.npy", np.ones((4, 4, 64), np.int32))
    relit("import", "histogram", tmp_path, "--bin-s", "1.5").refused("--bin-s 1.5: bins are 2.25e+08 m long: give seconds")
    assert files_in(tmp_path) == {"cw/frames.npy", "h.npy"}
    relit("import", "histogram", tmp_path, "--bin-s", "1.5e-6").well()  # 225 m, as of a lidar in the air


def kinect_packet(readings):
    """A depth packet of [9, 424, 512] readings, written from libfreenect2's order: eleven companded bits, a tenth image of zeros."""
    steps = np.repeat([1, 1, 2, 4, 8, 16, 32, 64], 128)
    levels = np.concatenate([[0], np.cumsum(steps)[:-1]])
    size = np.abs(np.rint(readings)).astype(int)
    code = np.searchsorted(levels, size, side="right") - 1
    code = np.where((readings < 0) & (code > 0), code + 1024, code)
    packet = np.zeros((10, 424, 352 * 16), np.uint8)
    for y in range(424):
        at = 11 * ((np.arange(512) & 3) * 128 + (np.arange(512) >> 2))[:, None] + np.arange(11)
        packet[:9, y + 212 if y < 212 else 423 - y, at] = code[:, 423 - y, :, None] >> np.arange(11) & 1
    return np.packbits(packet, axis=-1, bitorder="little").tobytes()


@pytest.mark.long
def test_a_packet_of_the_kinect(relit, tmp_path):
    """A wall before a Kinect v2 with an offset of each pixel and frequency, which the P0 tables say."""
    u, v = np.meshgrid(np.arange(512) + 0.5, np.arange(424) + 0.5)
    focal, centre = 365.5, (254.9, 205.4)
    truth = 1.6 * np.sqrt(1 + ((u - centre[0]) / focal) ** 2 + ((v - centre[1]) / focal) ** 2)
    p0 = (np.array([11418, 2284, 17128])[:, None, None] + 3 * u + 5 * v).astype(np.uint16)
    readings = [np.rint(900 * np.cos(4 * np.pi * f * truth / C + 2 * np.pi * i / 3 - table * 0.000031 * np.pi) + RNG.normal(0, 2, u.shape))
                for f, table in zip((80e6, 16e6, 120e6), p0, strict=True) for i in range(3)]
    (tmp_path / "dump").mkdir()
    (tmp_path / "dump" / "frame_0001.depth").write_bytes(kinect_packet(np.array(readings)))
    border = np.zeros((3, 1), "<u2")
    (tmp_path / "dump" / "p0tables.bin").write_bytes(bytes(32) + np.hstack([border, p0.reshape(3, -1), border]).astype("<u2").tobytes())
    maps, out = solve(relit, tmp_path / "capture", "kinect", tmp_path / "dump", tmp_path / "capture", "--focal-px", "365.5",
                      "--principal-px", "254.9,205.4")
    inside = np.zeros(truth.shape, bool)
    inside[:, 1:-1] = True
    assert maps.mask[inside].mean() > 0.99 and not maps.mask[~inside].any()
    assert np.median(np.abs(maps.range - truth)[maps.mask]) < 0.002  # steps of 8 in readings of 900, and the noise
    assert np.percentile(np.abs(maps.range - truth)[maps.mask], 99) < 0.01 and "frame_0001.depth" in out and "p0tables.bin" in out


def test_a_kinect_dump_that_is_none(relit, tmp_path):
    relit("import", "kinect", tmp_path).refused("holds no depth packet: name the depth packet with --packet")
    (tmp_path / "a.depth").write_bytes(bytes(2984960))
    relit("import", "kinect", tmp_path).refused("no file of P0 tables: name the file of P0 tables with --p0")
    (tmp_path / "b.depth").write_bytes(bytes(100))
    outcome = relit("import", "kinect", tmp_path, "--packet", tmp_path / "b.depth", "--p0", tmp_path / "a.depth")
    assert outcome.code == 2 and "b.depth: has 100 bytes, a depth packet of a Kinect v2 has" in outcome.err


@pytest.mark.parametrize("cut", [3, 40, 200, -30])
def test_a_damaged_archive_is_named(relit, tmp_path, cut):
    np.savez(tmp_path / "h.npz", counts=np.ones((4, 4, 9), np.int32))
    (tmp_path / "h.npz").write_bytes((tmp_path / "h.npz").read_bytes()[:cut])
    relit("import", "histogram", tmp_path, "--bin-s", "1e-10").refused("h.npz: is no whole .npz file of numbers")
    relit("import", "histogram", tmp_path / "none.npz", "--bin-s", "1e-10").refused("none.npz")


@pytest.mark.parametrize(("told", "right"), [(">u2", False), ("<u2", True)])
def test_counts_in_the_other_order_of_bytes_are_named(relit, tmp_path, told, right):
    """Few counts are above 255, so that in the other order nearly all are multiples of 256 and neighbours differ as much as in the right
    one."""
    counts = RNG.poisson(20 + 900 * (np.arange(16)[:, None, None] == 5) * RNG.random((ROWS, COLS))).astype("<u2")
    (tmp_path / "h.bin").write_bytes(counts.tobytes())
    ran = relit("import", "histogram", tmp_path, "--bin-s", "1e-9", "--bins", "first", "--dtype", told, "--size", f"{COLS}x{ROWS}")
    if right:
        ran.well()
    else:
        ran.refused("give --dtype '<u2'")
