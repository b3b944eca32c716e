"""Tables beside photographs that are none of their lights, which guess says."""

import json

import numpy as np
from scipy.io import savemat

from tests.scenes.captures import make_scene, write_image


def test_a_table_that_cannot_be_read_is_not_passed_over_in_silence(relit, tmp_path):
    for number, image in enumerate(make_scene(12, 9).images):
        write_image(tmp_path / f"{number}.png", np.round(image / image.max() * 60000).astype(np.uint16))
    (tmp_path / "names.txt").write_text("".join(f"photo {k}.png of 2024-05-0{k + 1}\n" for k in range(9)))
    assert "sure     yes" in relit("import", "guess", tmp_path).well()
    (tmp_path / "angles.csv").write_text("azimuth,elevation\n" + "".join(f"{40 * k},{50 + k}\n" for k in range(9)))
    said = relit("import", "guess", tmp_path).well()
    assert "angles.csv is no table of lights that can be read" in said and "sure     yes" not in said
    (tmp_path / "angles.csv").write_text("".join(f"{k} 1 2\n" for k in range(10)))
    said = relit("import", "guess", tmp_path).well()
    assert "angles.csv holds 10 lights, and there are 9 images" in said and "sure     yes" not in said
    (tmp_path / "angles.csv").unlink()
    for name, write in (("six.npy", lambda path: np.save(path, np.ones((9, 6)))),
                        ("two.mat", lambda path: savemat(path, {"dirs": np.ones((9, 3)), "strengths": np.ones((9, 3))})),
                        ("angles.json", lambda path: path.write_text(json.dumps([{"azimuth": 1, "elevation": 2}] * 9)))):
        write(tmp_path / name)
        assert f"{name} is no table of lights that can be read" in relit("import", "guess", tmp_path).well()
        (tmp_path / name).unlink()
