"""Layers of maps, and readings of single pixels, for the pages."""

import json
from typing import NamedTuple

import numpy as np
import pytest

from kernels.status import Status
from service.reporting.provenance import HASHING, LIGHTS
from service.requests.captures import ViewRequest
from service.viewing import pixel_readings
from service.viewing.view_files import view
from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.formats import exr
from stage.results.maps import SurfaceMaps
from stage.stack.ingest import LAYOUT
from tests.reference import shading
from tests.reference.view import View
from tests.scenes import near_lights
from tests.scenes.captures import edit_frame, make_scene, write_capture, write_exr, write_image, write_manifest
from tests.scenes.glossy import ALBEDO, F0, ROUGHNESS, dome, reflect, write_dome, write_maps

ROWS, COLS, LEFT = 299, 513, 41
UNSURE, DARK = (100, 200), (250, 400)
SURFACE = dome()
HALF_ROUNDING = 2.0**-11
SATURATED, HIDDEN, BACKLIT = 1, 2, 4


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


def show(folder, capture="cap", maps="maps", **options) -> View:
    view(ViewRequest(capture=folder / capture, maps=folder / maps, out=folder / "out", device="cpu", **options))
    return View(folder / "out")


@pytest.fixture(scope="module")
def shown_samples(tmp_path_factory) -> tuple[View, np.ndarray]:
    folder = tmp_path_factory.mktemp("samples")
    directions = write_dome(folder / "cap", SURFACE)
    write_maps(folder / "maps", SURFACE)
    return show(folder), directions


def test_measured_readings_are_those_of_the_images_and_lights_behind_are_told(shown_samples):
    found, directions = shown_samples
    facts = found.facts["samples"]
    assert (facts["rows"], facts["cols"], facts["step"], facts["lights"], facts["scale"]) == (24, 24, 1, 48, 1)
    measured = found.samples("measured")
    for light in (0, 17, 47):
        wanted = 2.0 * reflect(SURFACE.normal, directions[light]) * SURFACE.mask[..., None]
        np.testing.assert_allclose(measured[:, :, light], wanted, rtol=2 * HALF_ROUNDING, atol=1e-7)  # half in the stack and here
    cosine = SURFACE.normal @ directions.T
    clear = SURFACE.mask[..., None] & (np.abs(cosine) > 1e-3)
    assert np.array_equal((found.samples("used") & BACKLIT != 0)[clear], (cosine < 0)[clear])
    assert {name["name"] for name in found.facts["samples"]["codes"].values()} == {"saturated", "shadowed", "backlit"}


def test_the_model_is_the_material_of_the_maps_under_the_lights(shown_samples):
    """Against the float64 twin of lighting maps; a convex dome throws no shadow. Tolerance: albedo, F0 and samples are half values."""
    found, directions = shown_samples
    mask = SURFACE.mask
    count = int(mask.sum())
    pixels = shading.Pixels(SURFACE.normal[mask], np.tile(ALBEDO, (count, 1)), np.full((count, 3), F0), np.full(count, ROUGHNESS),
                            np.tile([0.0, 0.0, 1.0], (count, 1)), SURFACE.places[mask])
    wanted = 2.0 * np.moveaxis(shading.readings(pixels, directions), -1, 0)  # [pixels, lights, 3]
    seen = found.samples("used")[mask] & HIDDEN == 0
    assert seen.mean() > 0.5
    np.testing.assert_allclose(found.samples("model")[mask][seen], wanted[seen], rtol=6 * HALF_ROUNDING, atol=2e-5)
    assert (found.samples("model")[~mask] == 0).all()
    agree = (found.samples("used") == 0) & mask[..., None]
    np.testing.assert_allclose(found.samples("model")[agree], found.samples("measured")[agree], rtol=6 * HALF_ROUNDING, atol=2e-5)


@pytest.mark.long
def test_near_lights_are_where_they_are(tmp_path):
    """Each pixel has a direction and a distance of its own. Tolerance: half values, and heights in float32."""
    scene = near_lights.dome(24)
    lamps = near_lights.lamps(scene, 6, 4.0, exponent=1.5)
    near_lights.write(tmp_path / "cap", scene, lamps)
    camera = Capture.open(tmp_path / "cap").camera
    SurfaceMaps(camera=camera, mask=scene.mask, normal=scene.normal.astype(np.float32), diffuse_albedo=scene.albedo,
                height=scene.points[..., 2].astype(np.float32)).write(tmp_path / "maps" / "maps.exr")
    found = show(tmp_path)
    seen = scene.mask[..., None] & (found.samples("used") == 0)
    assert seen[scene.mask].mean() > 0.5
    wanted = np.stack([near_lights.render(scene, lamp) for lamp in lamps], axis=2)
    np.testing.assert_allclose(found.samples("model")[seen], wanted[seen], rtol=8 * HALF_ROUNDING, atol=1e-5)


@pytest.mark.parametrize("apart", [True, False])
def test_light_passes_behind_another_part(tmp_path, apart):
    """A plate 12 pixels before a wall, and light that comes level with the gap. Without parts the plate reaches back to the wall."""
    size, plate = 32, slice(14, 18)
    scene = make_scene(size, lights=3)
    write_capture(tmp_path / "cap", scene._replace(mask=np.ones((size, size), bool)))
    edit_frame(tmp_path / "cap", 1, light={"type": "distant", "direction": [-0.98894, 0, 0.14834], "irradiance": [1, 1, 1]})
    height, part = np.zeros((size, size), np.float32), np.ones((size, size), np.uint8)
    height[:, plate], part[:, plate] = 12, 2
    flat = np.tile(np.array([0, 0, 1], np.float32), (size, size, 1))
    SurfaceMaps(camera=Capture.open(tmp_path / "cap").camera, mask=np.ones((size, size), bool), normal=flat, diffuse_albedo=0 * flat + 0.5,
                height=height, part=part if apart else None).write(tmp_path / "maps" / "maps.exr")
    hidden = show(tmp_path).samples("used")[16, 20:30, 1] & HIDDEN != 0
    assert not hidden.any() if apart else hidden.all()


@pytest.mark.long
def test_refined_intensities_of_the_solve_light_the_model(tmp_path):
    write_dome(tmp_path / "cap", SURFACE, lights=12)
    write_maps(tmp_path / "maps", SURFACE)
    plain = show(tmp_path).samples("model")
    factors = np.linspace(0.5, 1.5, 12)
    report = {"found": {"light_factors": {"believed": True, "factors": factors.tolist()}}, "warnings": ["one thing"],
              "suspect_lights": [{"image": "003.exr", "misfit": 0.25}]}
    (tmp_path / "maps" / "report.json").write_text(json.dumps(report))
    found = show(tmp_path)
    np.testing.assert_allclose(found.samples("model"), plain * factors[:, None], rtol=3 * HALF_ROUNDING, atol=1e-6)
    suspects = [frame["suspect"] for frame in found.facts["frames"]]
    assert suspects[3].startswith("disagrees with the other lights by 25 %: ")
    assert suspects[:3] + suspects[4:] == [None] * 11 and found.facts["warnings"] == ["one thing"]
    (tmp_path / "maps" / "report.json").write_text('{"warnings": 3}')
    with pytest.raises(ValueError, match=r"report\.json: is not a report of relit"):
        show(tmp_path)


@pytest.mark.long
def test_every_second_pixel_of_a_large_image(tmp_path, monkeypatch):
    write_dome(tmp_path / "cap", SURFACE, lights=8)
    write_maps(tmp_path / "maps", SURFACE)
    whole = show(tmp_path)
    monkeypatch.setattr(pixel_readings, "MOST_BYTES", 13 * 8 * 12 * 12)
    found = show(tmp_path)
    assert [found.facts["samples"][name] for name in ("rows", "cols", "step")] == [12, 12, 2]
    for name in ("measured", "model", "used"):
        assert np.array_equal(found.samples(name), whole.samples(name)[::2, ::2])


def test_saturated_readings_are_told_and_bright_ones_fit(tmp_path):
    """Radiance beyond the largest half is kept by a scale."""
    scene = make_scene(size=8, lights=4)
    scene = scene._replace(images=scene.images * 1e6)
    write_capture(tmp_path / "cap", scene, saturation=2e5)
    rows, cols = scene.mask.shape
    SurfaceMaps(camera=Camera(projection="orthographic", resolution=(cols, rows)), mask=scene.mask,
                normal=scene.normal.astype(np.float32)).write(tmp_path / "maps" / "maps.exr")
    found = show(tmp_path)
    assert found.facts["samples"]["scale"] > 1 and found.facts["samples"]["model"] is None  # no albedo, no model
    measured = found.samples("measured")
    wanted = np.moveaxis(scene.images, 0, 2)
    np.testing.assert_allclose(measured, wanted, rtol=2 * HALF_ROUNDING)
    assert np.array_equal(found.samples("used") == SATURATED, (wanted >= 2e5).any(axis=-1))
    frame = found.facts["frames"][2]
    assert frame["saturated"] == pytest.approx((scene.images[2][scene.mask] >= 2e5).any(axis=-1).mean(), abs=1e-6)
    assert frame["mean"] == pytest.approx(scene.images[2][scene.mask].mean(axis=0), rel=1e-5)


def test_maps_of_other_images_give_no_samples_and_other_lights_no_model(tmp_path):
    write_dome(tmp_path / "cap", SURFACE, lights=8)
    write_maps(tmp_path / "maps", SURFACE, provenance={"relit:inputs": "another", HASHING: str(LAYOUT)})
    found = show(tmp_path)
    assert found.facts["samples"] is None
    assert any("was solved from other images than the capture has" in finding for finding in found.facts["findings"])
    tmp_path = tmp_path / "gradient"  # among the lights
    write_dome(tmp_path / "cap", SURFACE, lights=5)
    write_maps(tmp_path / "maps", SURFACE, provenance={LIGHTS: "others"})
    edit_frame(tmp_path / "cap", 0, light={"type": "gradient", "axis": "full"})
    found = show(tmp_path)
    assert any("was solved with other lights than" in finding for finding in found.facts["findings"])
    assert found.facts["samples"]["model"] is None and found.facts["relight"] is None
    assert found.facts["findings"]  # relit info says what is wrong with such a mixture
