"""The reader of .mat files against SciPy's writer, and files that are something else."""

import contextlib

import numpy as np
import pytest
from scipy.io import savemat

from stage.errors import ManifestError
from stage.formats.mat_file import read_mat

RNG = np.random.default_rng(1)
NUMBERS = {
    "S": RNG.normal(size=(8, 3)), "mu": np.ones((8, 1)), "one": np.array([[2.5]]), "single": RNG.normal(size=(2, 5)).astype(np.float32),
    "cube": RNG.integers(0, 60000, (4, 5, 6), dtype=np.uint16), "signed": np.array([[-7, 8]], dtype=np.int8),
    "wide": np.array([[2**40]], dtype=np.int64), "yes": np.array([[True, False]]),
}


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
