"""Files of RTI viewers, and of MATLAB."""

import contextlib

import numpy as np
import pytest
from scipy.io import savemat

from stage.errors import ManifestError, StorageError
from stage.formats.mat_file import read_mat
from stage.formats.rti import Hsh, Ptm, Quantization, dequantize, quantization_of_range, quantize, write_hsh, write_ptm
from tests.reference.light_basis import harmonics, polynomial, render_ptm, render_rti
from tests.scenes.captures import files_in

ROWS, COLS = 3, 4
RNG = np.random.default_rng(5)
LIGHTS = np.array([[0, 0, 1], [0.6, 0, 0.8], [-0.48, 0.6, 0.64]])
QUANTIZATION = quantization_of_range(RNG.uniform(-300, 0, 6), RNG.uniform(0, 300, 6))
MATS = np.random.default_rng(1)
NUMBERS = {
    "S": MATS.normal(size=(8, 3)), "mu": np.ones((8, 1)), "one": np.array([[2.5]]), "single": MATS.normal(size=(2, 5)).astype(np.float32),
    "cube": MATS.integers(0, 60000, (4, 5, 6), dtype=np.uint16), "signed": np.array([[-7, 8]], dtype=np.int8),
    "wide": np.array([[2**40]], dtype=np.int64), "yes": np.array([[True, False]]),
}


def stored(channels, terms):
    return RNG.integers(0, 256, (channels, ROWS, COLS, terms), dtype=np.uint8)


def make_ptm(channels):
    return Ptm(stored(channels, 6), QUANTIZATION, RNG.integers(0, 256, (ROWS, COLS, 3), dtype=np.uint8) if channels == 1 else None)


def make_hsh(terms):
    return Hsh(stored(3, terms), quantization_of_range(RNG.uniform(-1, 0, terms), RNG.uniform(0, 1, terms)))


def test_a_ptm_in_colour_byte_for_byte(tmp_path):
    bytes_of = np.arange(36, dtype=np.uint8).reshape(3, 2, 1, 6)  # two rows of one pixel
    quantization = Quantization(np.array([16, 1, 0.015625, 0.5, 2, 1.25], dtype=np.float32), np.array([141, 0, 255, 3, 128, 7]))
    write_ptm(tmp_path / "a.ptm", Ptm(bytes_of, quantization, None))
    header = b"PTM_1.2\nPTM_FORMAT_RGB\n1\n2\n16.0 1.0 0.015625 0.5 2.0 1.25\n141 0 255 3 128 7\n"
    body = bytes([*range(6, 12), *range(6), *range(18, 24), *range(12, 18), *range(30, 36), *range(24, 30)])  # the lower row first
    assert (tmp_path / "a.ptm").read_bytes() == header + body
    assert files_in(tmp_path) == {"a.ptm"}


def test_a_ptm_of_the_luminance_byte_for_byte(tmp_path):
    bytes_of, colour = np.arange(12, dtype=np.uint8).reshape(1, 2, 1, 6), np.arange(90, 96, dtype=np.uint8).reshape(2, 1, 3)
    quantization = Quantization(np.ones(6, dtype=np.float32), np.zeros(6, dtype=int))
    write_ptm(tmp_path / "a.ptm", Ptm(bytes_of, quantization, colour))
    header = b"PTM_1.2\nPTM_FORMAT_LRGB\n1\n2\n1.0 1.0 1.0 1.0 1.0 1.0\n0 0 0 0 0 0\n"
    assert (tmp_path / "a.ptm").read_bytes() == header + bytes([*range(6, 12), *range(6), 93, 94, 95, 90, 91, 92])


def test_harmonics_byte_for_byte(tmp_path):
    bytes_of = np.arange(24, dtype=np.uint8).reshape(3, 2, 1, 4)
    quantization = Quantization(np.array([1, 2, 4, 0.5], dtype=np.float32), np.array([0, 1, 2, 255]))
    write_hsh(tmp_path / "a.rti", Hsh(bytes_of, quantization))
    header = b"#HSH1.2\r\n3\r\n1 2 3\r\n4 2 1\r\n"
    numbers = np.array([255, 510, 1020, 127.5, 0, -2, -8, -127.5], dtype="<f4").tobytes()
    top, bottom = [*range(4), *range(8, 12), *range(16, 20)], [*range(4, 8), *range(12, 16), *range(20, 24)]
    assert (tmp_path / "a.rti").read_bytes() == header + numbers + bytes(top + bottom)


@pytest.mark.parametrize("channels", [3, 1])
def test_a_viewer_shows_a_ptm_as_meant(tmp_path, channels):
    made = make_ptm(channels)
    write_ptm(tmp_path / "a.ptm", made)
    coefficients = dequantize(np.moveaxis(made.stored, -1, 0), made.quantization)
    wanted = np.einsum("lt,tcrx->lrxc", polynomial(LIGHTS), coefficients)
    if made.colour is not None:
        wanted = wanted * made.colour / 255
    shown = render_ptm((tmp_path / "a.ptm").read_bytes(), LIGHTS)
    assert np.allclose(shown, np.clip(wanted / 255, 0, 1), atol=1e-5)  # coefficients in float


def test_a_viewer_shows_harmonics_as_meant(tmp_path):
    made = make_hsh(9)
    write_hsh(tmp_path / "a.rti", made)
    wanted = np.einsum("lt,tcrx->lrxc", harmonics(LIGHTS, 9), dequantize(np.moveaxis(made.stored, -1, 0), made.quantization))
    assert np.allclose(render_rti((tmp_path / "a.rti").read_bytes(), LIGHTS), np.clip(wanted, 0, 1), atol=1e-5)


def test_a_folder_that_is_none(tmp_path):
    (tmp_path / "file").write_text("x")
    for write, made in ((write_ptm, make_ptm(3)), (write_hsh, make_hsh(4))):
        with pytest.raises(StorageError, match="cannot write"):
            write(tmp_path / "file" / "a", made)
    assert files_in(tmp_path) == {"file"}


@pytest.mark.parametrize("low, high", [(-3.0, 5.0), (2.0, 7.0), (-7.0, -2.0), (0.0, 1e-6), (-1e4, 0.0)])
def test_a_coefficient_comes_back_within_half_a_step(low, high):
    quantization = quantization_of_range(np.array([low]), np.array([high]))
    values = np.linspace(low, high, 1001)[None]
    back = dequantize(quantize(values, quantization), quantization)
    # zero is a whole number of steps from the ends, so that an end may lie half a step outside; and the rounding of floats
    assert np.abs(back - values).max() <= 0.5 * quantization.step[0] + 2.0**-22 * max(abs(low), abs(high))
    assert quantization.step[0] == pytest.approx((max(high, 0) - min(low, 0)) / 255)


def test_zero_is_exact():
    quantization = quantization_of_range(np.array([-3.0, 2.0, 0.0]), np.array([5.0, 7.0, 0.0]))
    assert not dequantize(quantize(np.zeros((3, 4)), quantization), quantization).any()
    assert (quantization.zero >= 0).all() and (quantization.zero <= 255).all() and (quantization.step > 0).all()


def test_what_is_beyond_the_range_takes_its_end():
    quantization = quantization_of_range(np.array([-1.0]), np.array([1.0]))
    assert quantize(np.array([[-9.0, 9.0]]), quantization).tolist() == [[0, 255]]


@pytest.mark.parametrize("compressed", [False, True])
def test_numbers_texts_and_structures(tmp_path, compressed):
    path = tmp_path / "rig.mat"
    savemat(path, {**NUMBERS, "names": ["a.png", "bcd.png"], "files": np.array(["x y.png", "zz.png"], dtype=object), "note": "Größe",
                   "calib": {"K": np.eye(3), "light": {"Phi": np.ones((2, 3))}}, "spectrum": np.array([1j])}, do_compression=compressed)
    found = read_mat(path)
    for name, value in NUMBERS.items():
        assert found[name].dtype.kind == ("u" if name == "yes" else value.dtype.kind) and np.array_equal(found[name], value), name
    assert found["names"] == ("a.png", "bcd.png") and found["files"] == ("x y.png", "zz.png") and found["note"] == ("Größe",)
    assert np.array_equal(found["calib.K"], np.eye(3)) and found["calib.light.Phi"].shape == (2, 3)
    assert "spectrum" not in found


def test_what_is_no_mat_file_of_version_5(tmp_path):
    path = tmp_path / "rig.mat"
    savemat(path, {"S": np.ones((400, 3))}, do_compression=True)
    whole = path.read_bytes()
    for content, words in ((b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + bytes(200), r"version 7\.3: save it in MATLAB with save -v7"),
                           (b"# Created by Octave", "not a .mat file of version 5"), (b"", "not a .mat file of version 5"),
                           (whole[:-9], "damaged")):
        path.write_bytes(content)
        with pytest.raises(ManifestError, match=words) as caught:
            read_mat(path)
        assert "rig.mat" in str(caught.value) and "\n" not in str(caught.value)


def test_flipped_bytes_are_one_sentence_or_another_value(tmp_path):
    path = tmp_path / "rig.mat"
    savemat(path, {"S": np.arange(24.0).reshape(8, 3), "files": np.array(["x.png"], dtype=object), "calib": {"K": np.eye(3)}})
    whole = bytearray(path.read_bytes())
    for place in range(128, len(whole)):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1:])
        with contextlib.suppress(ManifestError):
            read_mat(path)
