"""Captures made by relit import, and where their lights stand."""

import json

import numpy as np
import pytest
from scipy.io import savemat

from service.captures.info import front_lights
from stage.capture.capture import Capture
from tests.scenes import near_lights
from tests.scenes.captures import angles_degrees, make_scene, render, write_exr, write_image
from tests.stage.stack.test_readings import SHINING, capture


def test_a_table_of_lights_in_other_axes_gives_the_true_normals(relit, tmp_path):
    axes, vectors, to_table = "down,right,away", "from-light", np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    scene = make_scene(24, 8)
    folder = tmp_path / "statue"
    for number, image in enumerate(scene.images):
        write_exr(folder / f"frame{number + 1}.exr", image)
    write_image(folder / "mask.png", scene.mask.astype(np.uint8) * 255)
    table = np.hstack([scene.directions @ to_table.T, scene.irradiance])
    (folder / "lights.csv").write_text("x,y,z,r,g,b\n" + "\n".join(",".join(f"{v:.9g}" for v in row) for row in table) + "\n")
    outcome = relit("import", "olat", folder, "--axes", axes, "--vectors", vectors)
    assert outcome.code == 0 and f"capture  {folder}/capture.json" in outcome.out and "handed" in outcome.out
    maps, *_ = relit.solve(folder, "--method", "robust")
    assert angles_degrees(maps.normal, scene.normal)[scene.mask].max() < 0.1  # half rounding of the stack


@pytest.mark.parametrize("layout", ["lp", pytest.param("olat", marks=pytest.mark.long)])
def test_the_scale_of_the_lights_gives_that_of_albedo(relit, tmp_path, layout):
    """`--scale` is the reading of a white surface that faces a light: albedo is then the true one, and relative without it."""
    scene, reading = make_scene(24, 8), 0.37
    folder = tmp_path / "statue"
    for number, image in enumerate(render(scene.normal, scene.albedo, scene.directions, np.full((8, 3), np.pi * reading))):
        write_exr(folder / f"{number}.exr", image)
    write_image(folder / "mask.png", scene.mask.astype(np.uint8) * 255)
    rows = [f"{number}.exr {x:.9g} {y:.9g} {z:.9g}" for number, (x, y, z) in enumerate(scene.directions)]
    (folder / "dome.lp").write_text("\n".join(["8", *rows]) + "\n")
    words = ["--axes", "right,up,towards", "--vectors", "to-light"] if layout == "olat" else []
    relit("import", layout, folder, *words, "--scale", reading).well()
    assert Capture.open(folder).manifest.irradiance_scale == "absolute"
    relit("import", layout, folder, *words, "--scale", reading).well()
    assert not (folder / "capture.previous.json").exists()  # nothing was replaced
    albedo = relit.solve(folder, "--method", "robust").maps.diffuse_albedo
    assert np.abs(albedo - scene.albedo)[scene.mask].max() < 2e-3  # half rounding of the stack and of the layers


@pytest.mark.parametrize("layout", ["lp", "olat"])
def test_a_light_that_a_table_has_twice_is_named(relit, tmp_path, layout):
    """A line that was copied and not changed; tables in which every light is twice, of two exposures, are as they should be."""
    scene = make_scene(8, 8)
    words = ["--axes", "right,up,towards", "--vectors", "to-light"] if layout == "olat" else []
    said = {}
    for what, order in (("copied", [0, 1, 2, 3, 4, 2, 6, 7]), ("right", range(8)), ("twice", [0, 0, 1, 1, 2, 2, 3, 3])):
        folder = tmp_path / what
        for number, image in enumerate(scene.images):
            write_exr(folder / f"{number}.exr", image)
        rows = [f"{number}.exr {' '.join(map(str, scene.directions[light]))}" for number, light in enumerate(order)]
        (folder / "dome.lp").write_text("\n".join(["8", *rows]) + "\n")
        relit("import", layout, folder, *words).well()
        said[what] = [words for words in Capture.open(folder).doubts if "has one light for" in words]
    assert said["right"] == said["twice"] == [] and len(said["copied"]) == 1
    assert "dome.lp has one light for 2.exr and 5.exr:" in said["copied"][0]


def test_axes_are_asked_for_and_never_guessed(relit, tmp_path):
    relit("import", "olat", tmp_path, "--vectors", "to-light").refused("--axes")
    relit("import", "olat", tmp_path, "--vectors", "to-light", "--axes", "right,up,forward").refused("axes")


NEAR_PS = np.diag([1.0, -1.0, -1.0])
"""The axes of near_ps from those of relit, and back."""


def write_near_ps(folder, dome, lights, ambient=0.02):
    """The layout of Quéau's near_ps: raw 16-bit PNG of the object, a mask, an ambient image, and both .mat files in the folder above."""
    images = [near_lights.render(dome, lamp) * dome.mask[..., None] for lamp in lights]
    scale = 0.9 / (max(image.max() for image in images) + ambient)
    for number, image in enumerate([*images, sum(images) / len(images)], start=1):
        name = f"photometric_sample_raw_{number:04d}.png" if number <= len(lights) else "photometric_sample_all_raw.png"
        write_image(folder / name, np.round((image + ambient) * scale * 65535).astype(np.uint16))
    write_image(folder / "photometric_sample_raw_ambient.png", np.full((*dome.mask.shape, 3), round(ambient * scale * 65535), np.uint16))
    write_image(folder / "photometric_sample_mask_raw.png", dome.mask.astype(np.uint8) * 255)
    savemat(folder.parent / "light.mat", {
        "S": 1000 * np.array([lamp.position for lamp in lights]) @ NEAR_PS, "Dir": np.array([lamp.axis for lamp in lights]) @ NEAR_PS,
        "Phi": np.array([lamp.strength for lamp in lights]) * 3e6, "mu": np.full((len(lights), 1), lights[0].exponent)})
    width, height = dome.camera["resolution"]
    focal = dome.camera["focal_px"][0]
    k = np.array([[focal, 0, width / 2 + 0.5], [0, focal, height / 2 + 0.5], [0, 0, 1]])
    savemat(folder.parent / "camera.mat", {"K": k.T})  # as MATLAB's toolbox writes it, transposed


def test_leds_in_the_layout_of_near_ps_give_the_true_height(relit, tmp_path):
    dome = near_lights.dome(perspective=True)
    folder = tmp_path / "Datasets" / "Statuette"
    write_near_ps(folder, dome, near_lights.lamps(dome, 8, 3.0, widest=50, exponent=1.4))
    out = relit("import", "near-lights", folder, tmp_path / "capture", "--lights", tmp_path / "Datasets" / "light.mat",
                    "--camera", tmp_path / "Datasets" / "camera.mat", "--axes", "right,down,away", "--unit-m", "0.001",
                    "--images", "*raw_0*", "--surface-z-m", dome.camera["surface_z_m"]).well()
    assert "8 near lights" in out and "(MATLAB)" in out and "raw_ambient.png is subtracted" in out
    camera = Capture.open(tmp_path / "capture").camera
    assert np.allclose(camera.principal_px, np.array(camera.resolution) / 2) and np.allclose(camera.focal_px, dome.camera["focal_px"])
    maps, *_ = relit.solve(tmp_path / "capture", "--method", "robust")
    solved = maps.mask & dome.mask
    assert solved.sum() > 0.95 * dome.mask.sum()
    assert np.abs(maps.height - dome.points[..., 2])[solved].max() < 0.01 * dome.relief  # as the capture in relit's own layout is held to
    assert angles_degrees(maps.normal, dome.normal)[solved].max() < 0.5  # 16-bit readings minus ambient light


@pytest.mark.long
def test_a_project_of_relightlab_gives_the_true_normals(relit, tmp_path):
    scene = make_scene(24, 8)
    images = [{"filename": f"DSC_{number:04d}.png", "skip": number == 3, "direction": dict.fromkeys("xyz", 0.0)} for number in range(9)]
    lit = iter(range(8))
    for entry in images:
        pixels = scene.images[next(lit)] if not entry["skip"] else np.ones_like(scene.images[0])
        write_image(tmp_path / "photos" / entry["filename"], np.round(pixels * 0.9 / scene.images.max() * 65535).astype(np.uint16))
    directions = [dict(zip("xyz", row, strict=True)) for row in scene.directions.tolist()]
    adjust = [dict(zip("rgb", row, strict=True)) for row in (1 / scene.irradiance).tolist()]
    (tmp_path / "lab").mkdir()
    (tmp_path / "lab" / "coin.relight").write_text(json.dumps({
        "application": "RelightLab", "version": "2025.02", "name": "coin", "width": 24, "height": 24,
        "folder": "../photos", "images": images,
        "lens": {"focalLength": 0}, "spheres": [], "crop": {"left": 2, "top": 2, "width": 20, "height": 20}, "dome": {
            "label": "", "imageWidth": 48.0, "domeDiameter": 600.0, "verticalOffset": 0.0, "lightConfiguration": "directional",
            "directions": directions, "positionsSphere": [], "positions3d": [], "ledAdjust": adjust}}))
    out = relit("import", "relightlab", tmp_path / "lab").well()
    assert "8 far lights" in out and "1 images are skipped" in out and "crops the images" in out
    capture = Capture.open(tmp_path / "photos")
    assert np.isclose(capture.camera.pixel_size_m, 0.002) and len(capture.manifest.frames) == 8
    maps, *_ = relit.solve(tmp_path / "photos", "--method", "robust")
    assert angles_degrees(maps.normal, scene.normal)[scene.mask & maps.mask].max() < 0.1
    assert maps.mask.sum() > 0.9 * scene.mask.sum()


@pytest.mark.long
def test_images_without_lights_are_solved_as_unknown_and_refused_as_known(relit, tmp_path):
    """What `--lights unknown` makes of them is judged in tests/service/solve/lights/test_unknown_lights.py."""
    scene = make_scene(24, 12)
    for number, image in enumerate(scene.images):
        write_exr(tmp_path / f"IMG_{number}.exr", image)
    write_image(tmp_path / "mask.png", scene.mask.astype(np.uint8) * 255)
    assert "12 placeholders, IMG_0.exr to IMG_11.exr" in relit("import", "photos", tmp_path).well()
    relit("solve", tmp_path, "--out", tmp_path / "maps").refused("placeholder")
    outcome = relit("solve", tmp_path, "--out", tmp_path / "maps", "--lights", "unknown", "--method", "robust")
    assert (outcome.code, outcome.err) == (1, "") and "no normal is sure" in outcome.out  # all are ambiguous: the object is matt
    (tmp_path / "few").mkdir()
    write_exr(tmp_path / "few" / "a.exr", scene.images[0])
    relit("import", "photos", tmp_path / "few").refused("few: has 1 images: normals need 3 or more")


def ring(degrees: float, count: int) -> np.ndarray:
    turn, tilt = 2 * np.pi * np.arange(count) / count, np.radians(degrees)
    return np.column_stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.full(count, np.cos(tilt))])


def test_angles_and_shares():
    found = front_lights(np.vstack([ring(30, 12), ring(60, 12)]))
    assert found.widest_deg == pytest.approx(60) and found.highlight_deg == pytest.approx(30)
    assert found.elsewhere == pytest.approx(0.75)  # of the sphere beyond a cone of 60 degrees
    assert found.dark == 0  # the half ring on the side of a normal faces it
    assert front_lights(np.vstack([ring(30, 5), [[1, 0, 0]]])) is None
    assert front_lights(ring(120, 5)) is None and front_lights(np.zeros((0, 3))) is None


def test_normals_that_three_lights_do_not_face():
    found = front_lights(ring(80, 3))
    z = np.random.default_rng(0).uniform(0, 1, (100_000, 1))
    turn = np.random.default_rng(1).uniform(0, 2 * np.pi, (100_000, 1))
    normals = np.hstack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z])
    dark = ((normals @ ring(80, 3).T > 0).sum(axis=1) < 3).mean()
    assert found.dark == pytest.approx(dark, abs=0.01)  # the standard error of the random normals is 0.002
    assert f"{100 * found.dark:.0f} % of the directions" in found.sentence()


def test_what_files_say_beside_the_manifest_is_told_at_once(relit, tmp_path):
    """Without a solve, or relit info."""
    for number, image in enumerate(make_scene(8, 4).images):
        write_exr(tmp_path / f"{number}.exr", image, **({"colorInteropID": "lin_ap1_scene"} if number else {}))
    assert "finding  color_space: lin_rec709_scene is declared, and lin_ap1_scene by 3" in relit("import", "photos", tmp_path).well()
    write_exr(tmp_path / "4.exr", np.zeros((4, 4, 3)))
    assert "4.exr: is 4x4, camera.resolution says 8x8" in relit("import", "photos", tmp_path).well()


def test_what_readings_show_is_recorded(relit, tmp_path):
    capture(tmp_path, np.minimum(1.2 * SHINING, 1), full=4095)
    (tmp_path / "capture.json").unlink()
    said, = (line for line in relit("import", "photos", tmp_path).well().splitlines() if line.startswith("finding  saturation:"))
    assert said.removeprefix("finding  ") in Capture.open(tmp_path).doubts


def test_an_image_that_cannot_be_read_takes_nothing_from_what_headers_say(relit, tmp_path):
    for number, image in enumerate(make_scene(8, 4).images):
        write_exr(tmp_path / f"{number}.exr", image - (number == 2), **({"colorInteropID": "lin_ap1_scene"} if number else {}))
    said = relit("import", "photos", tmp_path).well()
    assert "finding  color_space:" in said and "fault    " in said and "2.exr: 64 pixels are negative" in said
