"""relit relight: sums of captured images against their closed forms, and every option of the frames."""

import json

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from stage.formats import exr
from stage.results.maps import SurfaceMaps
from tests.scenes.captures import files_in, make_scene, rgb, write_capture, write_exr

SCENE = make_scene(size=16, lights=7)


def constant_capture(folder):
    """Seven lights of irradiance 2, and the same grey under each."""
    lights = [{"type": "distant", "direction": d.tolist(), "irradiance": [2, 2, 2]} for d in SCENE.directions]
    write_capture(folder, SCENE, frames=[{"image": f"{i:03d}.exr", "light": light} for i, light in enumerate(lights)])
    for index in range(len(lights)):
        write_exr(folder / f"{index:03d}.exr", np.full((16, 16, 3), 0.25))
    return folder


def test_relight_under_an_even_sky_sums_to_the_sphere(relit, tmp_path):
    constant_capture(tmp_path / "cap")
    write_exr(tmp_path / "even.exr", np.ones((16, 32, 3)) * (1, 0.5, 2))
    outcome = relit.done("relight", tmp_path / "cap", "--environment", tmp_path / "even.exr", "--out", tmp_path / "f" / "a.###.exr",
                         "--frames", "8-10", "--spin-degrees", "90")
    frames, matte, warning = outcome.out.splitlines()  # the lights are all in front, the sky is not
    assert matte.startswith("matte    none: the background is lit")
    assert frames == f"frames   {tmp_path}/f/a.008.exr … a.010.exr" and "comes from directions more than" in warning
    assert files_in(tmp_path / "f") == {"a.008.exr", "a.009.exr", "a.010.exr"}
    for number in (8, 9, 10):
        channels, metadata = exr.read(tmp_path / "f" / f"a.{number:03d}.exr")
        assert metadata["relit:frame"] == str(number) and metadata["relit:capture"] == "cap"
        for name, level in (("R", 1), ("G", 0.5), ("B", 2)):
            # 4π·L·0.25/2; the midpoint rule of 16 rows is 0.2 % above the sphere at the most, half rounding 0.05 %
            assert channels[name].dtype == np.float16
            assert np.allclose(channels[name], 4 * np.pi * level * 0.25 / 2, rtol=3e-3)


def test_relight_turns_the_environment_from_the_camera_to_the_right(relit, tmp_path):
    scene = make_scene(size=4, lights=4)
    directions = [[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0]]
    frames = [{"image": f"{i:03d}.exr", "light": {"type": "distant", "direction": d, "irradiance": [1, 1, 1]}} for i, d in
              enumerate(directions)]
    write_capture(tmp_path / "cap", scene, frames=frames)
    for index in range(4):
        write_exr(tmp_path / "cap" / f"{index:03d}.exr", np.full((4, 4, 3), index + 1.0))
    sky = np.zeros((8, 16, 3))
    sky[3:5, 7:9] = 1  # around +z
    write_exr(tmp_path / "sky.exr", sky)
    relit("relight", tmp_path / "cap", "--environment", tmp_path / "sky.exr", "--out", tmp_path / "a.#.exr", "--frames", "1-4",
          "--spin-degrees", "360", "--weights", "cells")
    levels = [float(exr.read(tmp_path / f"a.{i}.exr")[0]["G"].mean()) for i in (1, 2, 3, 4)]
    assert np.allclose(np.array(levels) / levels[0], [1, 2, 3, 4], rtol=5e-3)  # half, and texels cut by no cell border


def test_one_light_is_enough_to_relight(relit, tmp_path):
    scene = make_scene(size=4, lights=1)
    write_capture(tmp_path / "cap", scene)
    write_exr(tmp_path / "even.exr", np.ones((8, 16, 3)))
    assert relit("relight", tmp_path / "cap", "--environment", tmp_path / "even.exr", "--out", tmp_path / "a.#.exr").code == 0
    expected = scene.images[0] / scene.irradiance[0] * 4 * np.pi
    assert np.allclose(exr.read(tmp_path / "a.1.exr")[0]["R"], expected[..., 0], rtol=1e-2)  # the midpoint rule of 8 rows: 0.65 %


def test_one_pixel_is_enough_to_relight(relit, tmp_path):
    write_capture(tmp_path / "cap", make_scene(size=1, lights=3))
    write_exr(tmp_path / "even.exr", np.ones((2, 4, 3)))
    relit.done("relight", tmp_path / "cap", "--environment", tmp_path / "even.exr", "--out", tmp_path / "a.#.exr")
    assert exr.read(tmp_path / "a.1.exr")[0]["R"].shape == (1, 1)


@pytest.fixture
def lit(relit, tmp_path):
    """Relight the constant capture under an even sky with further options; the outcome and the frames' folder."""
    constant_capture(tmp_path / "cap")
    sky = write_exr(tmp_path / "even.exr", np.ones((16, 32, 3)) * (1, 0.5, 2))

    def run(name, *options, capture=tmp_path / "cap"):
        outcome = relit("relight", capture, "--environment", sky, "--out", tmp_path / name / "a.##.exr", *options)
        return outcome, tmp_path / name

    return run


def test_exposure_is_a_power_of_two(lit):
    (_, plain), (_, up) = lit("plain"), lit("up", "--exposure", "-1.5")
    assert np.allclose(rgb(up / "a.01.exr"), 2**-1.5 * rgb(plain / "a.01.exr"), rtol=1e-3)  # half rounding of both
    assert exr.read_header(up / "a.01.exr").metadata["relit:exposure_stops"] == "-1.5"


def test_acescg_frames_are_converted_and_say_so(lit):
    (_, plain), (outcome, aces) = lit("plain"), lit("aces", "--color-space", "lin_ap1_scene")
    assert outcome.code == 0
    # Rec.709 to AP1 with the Bradford adaptation, to the five digits that ACES publishes
    matrix = np.array([[0.61310, 0.33952, 0.04738], [0.07019, 0.91635, 0.01345], [0.02062, 0.10957, 0.86981]])
    assert np.allclose(rgb(aces / "a.01.exr"), rgb(plain / "a.01.exr") @ matrix.T, rtol=1e-3)
    metadata = exr.read_header(aces / "a.01.exr").metadata
    assert metadata["colorInteropID"] == "lin_ap1_scene"
    assert np.allclose(metadata["chromaticities"], [0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767], atol=1e-5)


def test_compressions(lit):
    frames = {name: lit(name, "--compression", name)[1] / "a.01.exr" for name in ("zip", "piz", "dwaa")}
    for name, path in frames.items():
        assert exr.read_header(path).metadata["compression"] == getattr(OpenEXR, f"{name.upper()}_COMPRESSION")
    assert np.array_equal(rgb(frames["zip"]), rgb(frames["piz"]))
    assert np.allclose(rgb(frames["zip"]), rgb(frames["dwaa"]), rtol=0.01)  # lossy by its nature


def test_weights_keep_the_energy_and_share_it_differently(lit, tmp_path):
    sun = np.zeros((32, 64, 3))
    sun[15, 32] = 100  # 4 degrees beside the light in front, whose cell ends at 15
    write_exr(tmp_path / "even.exr", sun)
    for index in range(7):
        write_exr(tmp_path / "cap" / f"{index:03d}.exr", np.full((16, 16, 3), 1.0 + index))
    (_, cells), (_, smooth), (outcome, kernel) = (lit(name, "--weights", name) for name in ("cells", "smooth", "kernel"))
    assert outcome.code == 0
    assert np.array_equal(rgb(lit("default")[1] / "a.01.exr"), rgb(kernel / "a.01.exr"))
    energy = 100 * np.sin(np.pi * 15.5 / 32) * (np.pi / 32) * (2 * np.pi / 64) / 2
    whole = rgb(cells / "a.01.exr")[0, 0, 0] / energy
    shared, fitted = (rgb(each / "a.01.exr")[0, 0, 0] / energy for each in (smooth, kernel))
    assert whole == pytest.approx(1, rel=1e-3)  # half; all of it on the light in front
    assert 1.05 < shared < 7 and 1.001 < fitted < shared  # the lights beside take over more slowly than linearly


def test_maps_that_do_not_fit(relit, lit, tmp_path):
    write_capture(tmp_path / "small", make_scene(size=8, lights=7))
    assert relit("solve", tmp_path / "small", "--method", "lambert", "--out", tmp_path / "maps").code == 0
    outcome, out = lit("out", "--aov", "normal", "--maps", tmp_path / "maps")
    assert (outcome.code, out.exists()) == (2, False)
    assert outcome.err.startswith(f"relit: {tmp_path / 'maps' / 'maps.exr'}: is 8x8, the capture 16x16: ") and "--crop" in outcome.err
    maps = SurfaceMaps.read(tmp_path / "maps" / "maps.exr")
    SurfaceMaps(camera=maps.camera, mask=maps.mask).write(tmp_path / "maps" / "maps.exr")
    outcome, _ = lit("out", "--aov", "normal", "--maps", tmp_path / "maps", capture=tmp_path / "small")
    assert outcome.err == f"relit: {tmp_path / 'maps' / 'maps.exr'}: has no layer normal, which --aov normal needs\n"


def test_pixels_beyond_half_are_clipped_and_counted(lit):
    outcome, out = lit("out", "--exposure", "20", "--aov", "mask")
    assert outcome.code == 0 and "clipped  256 pixels" in outcome.out
    assert rgb(out / "a.01.exr").max() == 65504


def test_a_map_a_frame(relit, tmp_path):
    constant_capture(tmp_path / "cap")
    for number in (9, 10, 11):
        write_exr(tmp_path / f"sky.{number:03d}.exr", np.full((8, 16, 3), float(number)))
    relit.done("relight", tmp_path / "cap", "--environment", tmp_path / "sky.###.exr", "--out", tmp_path / "f" / "a.####.exr",
               "--frames", "9-11")
    levels = [rgb(tmp_path / "f" / f"a.{number:04d}.exr").mean() for number in (9, 10, 11)]
    assert np.allclose(np.array(levels) / levels[0], [1, 10 / 9, 11 / 9], rtol=1e-3)  # half


@pytest.mark.parametrize(("spoil", "words"), [
    (lambda path: path.unlink(), "frame 3 has no map: sky.03.exr is not there"),
    (lambda path: write_exr(path, np.ones((4, 9, 3))), "sky.03.exr: is 9x4: a lat-long map is twice as wide as high"),
    (lambda path: write_exr(path, np.full((4, 8, 3), np.inf)), "sky.03.exr: 32 pixels are not finite"),
    (lambda path: write_exr(path, np.full((4, 8, 3), -1.0)), "sky.03.exr: 32 pixels are negative"),
], ids=["missing", "another shape", "infinite", "negative"])
def test_a_bad_map_of_a_sequence_is_named_before_any_frame(relit, tmp_path, monkeypatch, spoil, words):
    monkeypatch.chdir(tmp_path)
    constant_capture(tmp_path / "cap")
    for number in (1, 2, 3):
        write_exr(tmp_path / f"sky.{number:02d}.exr", np.ones((4, 8, 3)))
    spoil(tmp_path / "sky.03.exr")
    relit("relight", "cap", "--environment", "sky.##.exr", "--out", "f/a.##.exr", "--frames", "1-3").refused(words)
    assert not (tmp_path / "f").exists()


def test_the_contact_sheet_shows_the_frames_as_they_are(lit, tmp_path):
    def sheet(name, *options):
        outcome, out = lit(name, "--frames", "1-5", "--spin-degrees", "100", "--sheet", tmp_path / name / "s.png", *options)
        assert outcome.code == 0 and f"sheet    {tmp_path}/{name}/s.png\n" in outcome.out
        assert files_in(out) == {"s.png", *(f"a.0{i}.exr" for i in range(1, 6))}
        return np.asarray(oiio.ImageBuf(str(tmp_path / name / "s.png")).get_pixels(oiio.FLOAT))

    plain, dark = sheet("plain"), sheet("dark", "--exposure", "-4")
    assert plain.shape == dark.shape and plain.shape[2] == 3
    assert plain[136, 110].min() > 0.5 > dark[136, 110].max() > 0.1  # the middle of the first frame


def test_the_report_says_what_was_made_and_how_long_it_took(lit, tmp_path):
    lit("out", "--frames", "2-3")
    outcome, _ = lit("out", "--frames", "1-3", "--report", tmp_path / "r.json")
    assert f"report   {tmp_path}/r.json\n" in outcome.out
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["schema"] == "relit.report/1" and report["options"]["frames"] == "1-3"
    assert report["frames"] == {"made": 1, "skipped": 2, "clipped_pixels": 0, "first": f"{tmp_path}/out/a.01.exr",
                                "last": f"{tmp_path}/out/a.03.exr"}
    assert set(report["timings_s"]) == {"open", "ingest", "frames", "of these", "on writing threads"}
    assert report["inputs"]["captures"][0]["name"] == "cap" and len(report["inputs"]["captures"][0]["content"]) == 16
