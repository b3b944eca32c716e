"""From files in the layouts of other programs to a result in two commands, with the truth known."""

import numpy as np
import pytest

from stage.maps import SurfaceMaps
from tests.scenes.captures import make_scene, write_exr, write_image


def degrees_between(a, b):
    return np.degrees(np.arccos(np.clip(np.sum(a * b, axis=-1), -1, 1)))


@pytest.mark.parametrize(("axes", "vectors", "to_table"), [
    ("right,up,towards", "to-light", np.diag([1, 1, 1])), ("right,down,away", "from-light", -np.diag([1, -1, -1])),
    ("down,right,towards", "to-light", np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])),
])
def test_a_table_of_lights_in_any_axes_gives_the_true_normals(relit, tmp_path, axes, vectors, to_table):
    scene = make_scene(24, 8)
    folder = tmp_path / "statue"
    for number, image in enumerate(scene.images):
        write_exr(folder / f"frame{number + 1}.exr", image)
    write_image(folder / "mask.png", scene.mask.astype(np.uint8) * 255)
    table = np.hstack([scene.directions @ to_table.T, scene.irradiance])
    (folder / "lights.csv").write_text("x,y,z,r,g,b\n" + "\n".join(",".join(f"{v:.9g}" for v in row) for row in table) + "\n")
    outcome = relit("import", "olat", folder, "--axes", axes, "--vectors", vectors)
    assert outcome.code == 0 and f"capture  {folder}/capture.json" in outcome.out and "handed" in outcome.out
    assert relit("solve", folder, "--out", tmp_path / "maps", "--method", "robust").code == 0
    maps = SurfaceMaps.read(tmp_path / "maps" / "maps.exr")
    assert degrees_between(maps.normal, scene.normal)[scene.mask].max() < 0.1  # half rounding of the stack


def test_axes_are_asked_for_and_never_guessed(relit, tmp_path):
    outcome = relit("import", "olat", tmp_path, "--vectors", "to-light")
    assert outcome.code == 2 and "--axes" in outcome.err and outcome.err.count("\n") == 1
    outcome = relit("import", "olat", tmp_path, "--vectors", "to-light", "--axes", "right,up,forward")
    assert outcome.code == 2 and "axes" in outcome.err and outcome.err.count("\n") == 1
