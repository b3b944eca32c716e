"""The layers of a view: level 0 holds the values of maps.exr, and lower levels hide no pixel that is unsure."""

from typing import NamedTuple

import numpy as np
import pytest

from kernels.status import Status
from service.requests.captures import ViewRequest
from service.viewing.view_files import view
from stage.capture.capture import Capture
from stage.formats import exr
from stage.results.maps import SurfaceMaps
from tests.reference.view import View
from tests.scenes.captures import write_exr, write_image, write_manifest

ROWS, COLS, LEFT = 299, 513, 41
UNSURE, DARK = (100, 200), (250, 400)


class Shown(NamedTuple):
    """Maps of more than one tile with odd sizes, an empty strip at the left and two unsolved pixels; and their view."""

    maps: SurfaceMaps
    file: dict[str, np.ndarray]
    view: View


@pytest.fixture(scope="module")
def shown(tmp_path_factory) -> Shown:
    folder = tmp_path_factory.mktemp("view")
    mask = np.ones((ROWS, COLS), dtype=bool)
    mask[:, :LEFT] = False
    write_exr(folder / "cap" / "000.exr", np.full((ROWS, COLS, 3), 0.5))
    write_image(folder / "cap" / "mask.png", np.where(mask, 255, 0).astype(np.uint8))
    write_manifest(folder / "cap", {
        "schema": "relit.capture/1", "name": "cap", "camera": {"projection": "orthographic", "resolution": [COLS, ROWS]},
        "mask": "mask.png",
        "frames": [{"image": "000.exr", "light": {"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}}]})
    rng = np.random.default_rng(5)
    status = np.where(mask, Status.OK, Status.UNSOLVED).astype(np.uint8)
    status[UNSURE], status[DARK] = Status.UNSURE, Status.DARK
    mask[UNSURE] = mask[DARK] = False
    estimated = mask.copy()
    estimated[UNSURE] = True
    normal = rng.normal(size=(ROWS, COLS, 3)).astype(np.float32)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    maps = SurfaceMaps(camera=Capture.open(folder / "cap").camera, mask=mask, estimated=estimated, normal=normal, status=status,
                       roughness=rng.random((ROWS, COLS)), part=(1 + (np.arange(COLS) > 300) * np.ones((ROWS, 1))).astype(np.uint8),
                       height=rng.normal(size=(ROWS, COLS)).astype(np.float32))
    maps.write(folder / "maps.exr")
    view(ViewRequest(capture=folder / "cap", maps=folder, out=folder / "out", device="cpu"))
    return Shown(maps, exr.read(folder / "maps.exr")[0], View(folder / "out"))


def test_tiles_of_level_0_hold_the_values_of_the_file_and_every_code_has_a_name(shown):
    names = [layer["name"] for layer in shown.view.facts["layers"]]
    assert names == ["normal", "roughness", "height", "part", "status", "mask"]  # as a person looks at them
    for layer in shown.view.facts["layers"]:
        stored = np.stack([shown.file[f"{layer['name']}.{suffix}"] for suffix in layer["channels"]])
        image = shown.view.image(layer["name"])
        assert image.dtype == stored.dtype == layer["dtype"]
        assert np.array_equal(image, stored)
    codes = shown.view.facts["codes"]
    assert {int(code): found["name"] for code, found in codes.items()} == {int(status): status.name.lower() for status in Status}
    assert all(found["meaning"].endswith(".") for found in codes.values())
    assert [code for code, found in codes.items() if found["estimate"]] == ["1", "8", "9", "12", "13", "14", "15"]


def test_levels_halve_until_one_tile_holds_them_and_have_the_means_of_the_solved_pixels(shown):
    for layer in shown.view.facts["layers"]:
        assert [(level["rows"], level["cols"]) for level in layer["levels"]] == [(299, 513), (150, 257), (75, 129)]
        assert all(np.isfinite(shown.view.image(layer["name"], level)).all() for level in range(3))
    length = np.linalg.norm(shown.view.image("normal", 2), axis=0)
    solved = np.arange(length.shape[1]) > LEFT // 4
    assert np.allclose(length[:, solved], 1, atol=1e-6) and (length[:, : LEFT // 4] == 0).all()
    full, mask, half = shown.view.image("height")[0].astype(float), shown.maps.mask, shown.view.image("height", 1)[0]
    for row, col in ((0, 20), (0, 21), (UNSURE[0] // 2, UNSURE[1] // 2), (149, 256), (60, 99)):
        block = slice(2 * row, 2 * row + 2), slice(2 * col, 2 * col + 2)
        assert half[row, col] == pytest.approx(full[block][mask[block]].mean(), rel=1e-6)  # float32 rounding
    assert (half[:, : LEFT // 2] == 0).all()


@pytest.mark.parametrize("level", [1, 2])
def test_an_unsure_pixel_never_vanishes(shown, level):
    """One pixel of 150 000 that is unsure or dark makes its pixel of every level so, and the background beside the object does not."""
    status, mask = shown.view.image("status", level)[0], shown.view.image("mask", level)[0]
    for place, code in ((UNSURE, Status.UNSURE), (DARK, Status.DARK)):
        row, col = (index >> level for index in place)
        assert status[row, col] == code and mask[row, col] == 0
    assert set(np.unique(status)) == {Status.UNSOLVED, Status.OK, Status.UNSURE, Status.DARK}
    border = LEFT >> level  # half of these pixels lie outside
    assert (status[:10, border] == Status.OK).all() and (mask[:10, border] == 1).all()
    assert (mask[:, : border] == 0).all()
    assert (mask == 0).sum() == border * mask.shape[0] + 2


def test_ranges_and_histograms_count_the_solved_pixels(shown):
    layer = shown.view.layer("roughness")
    solved = shown.file["roughness.Y"][shown.maps.mask].astype(float)
    assert layer["range"] == pytest.approx(np.percentile(solved, [1, 99]), rel=1e-6)
    counts = np.array(layer["histogram"]["counts"])
    edges = np.linspace(layer["histogram"]["low"], layer["histogram"]["high"], 65)
    wanted, _ = np.histogram(np.clip(solved, edges[0], edges[-1]), edges)
    assert counts.shape == (1, 64) and counts.sum() == len(solved)
    assert np.abs(counts[0] - wanted).max() <= 100  # half values on the edge of a bin
    status = shown.view.layer("status")
    assert status["range"] == [Status.UNSOLVED, Status.OK, Status.DARK, Status.UNSURE]
    assert status["histogram"]["counts"][0][Status.OK] == len(solved) and sum(status["histogram"]["counts"][0]) == len(solved) + 2
