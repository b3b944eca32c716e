"""Captures are opened with checks that name the file; cameras map pixels to rays and back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from stage.capture.camera import Camera, Distortion
from stage.capture.capture import Capture
from stage.capture.lighting import check_solvable, distant_lights
from stage.errors import ImageError, ManifestError
from tests.scenes.captures import (
    edit_frame,
    edit_manifest,
    make_scene,
    manifest_of,
    ring,
    write_capture,
    write_exr,
    write_image,
    write_radiance,
)

SCENE = make_scene(size=6, lights=4)


def refused(folder, error=ManifestError) -> str:
    with pytest.raises(error) as caught:
        Capture.open(folder)
    text = str(caught.value)
    assert text.count(str(folder)) == 1 and "\n" not in text
    return text


def test_another_colour_space_in_the_images_is_said(tmp_path):
    """Frames of images in ACEScg were 13 % off under a manifest without a colour space."""
    write_capture(tmp_path, SCENE)
    assert Capture.open(tmp_path).doubts == ()
    for index in (1, 3):
        write_exr(tmp_path / f"{index:03d}.exr", SCENE.images[index], colorInteropID="lin_ap1_scene")
    doubt, = Capture.open(tmp_path).doubts
    assert "lin_ap1_scene by 2 of the 4 images, 001.exr the first" in doubt and "lin_rec709_scene" in doubt
    edit_manifest(tmp_path, color_space="lin_ap1_scene")
    assert Capture.open(tmp_path).doubts == ()


def test_grey_images_among_coloured_ones_are_said(tmp_path):
    write_capture(tmp_path, SCENE)
    for index in range(4):
        write_exr(tmp_path / f"{index:03d}.exr", SCENE.images[index].mean(axis=-1))
        doubts = Capture.open(tmp_path).doubts
        assert ("000.exr the first of them, are grey" in " ".join(doubts)) == (index < 3)


def test_encodings_that_files_declare_are_said(tmp_path):
    """EXR images that OpenImageIO made of photographs, and Radiance images of another gamma: both were taken as linear without a word."""
    write_capture(tmp_path, SCENE)
    write_exr(tmp_path / "002.exr", SCENE.images[2], colorInteropID="srgb_rec709_scene")
    doubt, = Capture.open(tmp_path).doubts
    assert "srgb_rec709_scene by 1 of the 4 images, 002.exr" in doubt
    frames = manifest_of(SCENE)["frames"]
    for index, (image, frame) in enumerate(zip(SCENE.images, frames, strict=True)):
        frame["image"] = write_radiance(tmp_path / f"{index}.hdr", image, "GAMMA=2.2").name
    edit_manifest(tmp_path, frames=frames)
    doubt, = Capture.open(tmp_path).doubts
    assert doubt.startswith("0.hdr: its header says GAMMA=2.2, and so do those of 4 of 4 images")


def test_images_of_eight_bits_among_others_are_named(tmp_path):
    """Previews or JPEG files beside linear originals: nothing could be solved, and nothing said why."""
    write_capture(tmp_path, SCENE)
    frames = manifest_of(SCENE)["frames"]
    frames[2]["image"] = write_image(tmp_path / "002.png", np.zeros((*SCENE.images[0].shape[:2], 3), dtype=np.uint8)).name
    edit_manifest(tmp_path, frames=frames)
    doubt, = Capture.open(tmp_path).doubts
    assert "1 of the 4 images, 002.png the first of them, have 8 bits and the others more" in doubt


def test_pixels_of_another_shape_than_the_camera_are_named(tmp_path):
    """Anamorphic images, which were read as if their pixels were square; a camera whose focal lengths say the shape has no doubt."""
    write_capture(tmp_path, SCENE)
    for index in (1, 2):
        write_exr(tmp_path / f"{index:03d}.exr", SCENE.images[index], pixelAspectRatio=2.0)
    doubt, = Capture.open(tmp_path).doubts
    assert "pixelAspectRatio: is 2 in 2 of the 4 images, 001.exr the first of them, and 1 of the camera" in doubt
    for index in range(4):
        write_exr(tmp_path / f"{index:03d}.exr", SCENE.images[index], pixelAspectRatio=2.0)
    edit_manifest(tmp_path, camera={"projection": "perspective", "resolution": list(SCENE.images[0].shape[1::-1]), "focal_px": [50, 100]})
    assert Capture.open(tmp_path).doubts == ()


def test_a_folder_or_its_manifest(tmp_path):
    write_capture(tmp_path, SCENE)
    by_folder, by_file = Capture.open(tmp_path), Capture.open(tmp_path / "capture.json")
    assert by_folder == by_file
    assert by_folder.name == "cap"
    assert (by_folder.mask() == SCENE.mask).all()
    assert Capture.open(write_capture(tmp_path, SCENE, mask=None)).mask().all()


def test_the_frames_by_what_lit_them(tmp_path):
    write_capture(tmp_path, SCENE)
    edit_frame(tmp_path, 1, light={"type": "off"})
    edit_frame(tmp_path, 2, light={"type": "full"})
    capture = Capture.open(tmp_path)
    assert [frame.image for frame in capture.sources()] == ["000.exr", "003.exr"]
    lights = distant_lights(capture)
    assert np.allclose(lights.direction, SCENE.directions[[0, 3]]) and np.allclose(lights.irradiance, SCENE.irradiance[[0, 3]])


def test_no_folder_and_no_manifest(tmp_path):
    assert refused(tmp_path / "none").endswith("none: there is no such folder")
    assert "holds no capture.json: see `relit import`" in refused(tmp_path)
    (tmp_path / "file").write_text("")
    assert "there is no such folder" in refused(tmp_path / "file" / "below")


@pytest.mark.parametrize(("change", "words"), [
    ({"mask": "none.png"}, "capture.json: mask: none.png is not in the folder"),
    ({"dark": "none.exr"}, "capture.json: dark: none.exr is not in the folder"),
    ({"flat": "../flat.exr"}, "capture.json: ../flat.exr leads out of the capture's folder"),
    ({"flat": "/etc/passwd"}, "capture.json: /etc/passwd leads out of the capture's folder"),
])
def test_files_that_are_not_there_or_not_here(tmp_path, change, words):
    write_capture(tmp_path, SCENE, **change)
    assert words in refused(tmp_path)


def test_an_environment_reference_has_a_size_of_its_own(tmp_path):
    write_capture(tmp_path, SCENE)
    edit_frame(tmp_path, 3, light={"type": "environment", "image": "probe.exr"})
    assert "frames[3].light.image: probe.exr is not in the folder" in refused(tmp_path)
    write_exr(tmp_path / "probe.exr", np.ones((4, 8, 3)))
    assert len(Capture.open(tmp_path).sources()) == 3


def test_arrays_are_for_time_of_flight_alone(tmp_path):
    write_capture(tmp_path, SCENE)
    np.save(tmp_path / "a.npy", np.zeros((6, 6, 9)))
    edit_frame(tmp_path, 3, image="a.npy")
    assert "a.npy: has an unknown suffix" in refused(tmp_path, ImageError)
    edit_frame(tmp_path, 3, light=None, tof={"type": "pulsed", "bin_s": 1e-10, "start_s": 0})
    assert len(Capture.open(tmp_path).sources()) == 3


def test_coplanar_lights_cannot_be_solved(tmp_path):
    write_capture(tmp_path, SCENE)
    for index, x in enumerate((-0.5, -0.2, 0.3, 0.6)):
        edit_frame(tmp_path, index, light={"type": "distant", "direction": [x, 0.0, 1.0], "irradiance": [1, 1, 1]})
    with pytest.raises(ManifestError, match="all 4 lights lie in one plane through the object"):
        check_solvable(Capture.open(tmp_path))
    edit_frame(tmp_path, 3, light={"type": "distant", "direction": [0.6, 0.01, 1.0], "irradiance": [1, 1, 1]})
    assert len(check_solvable(Capture.open(tmp_path)).direction) == 4


def test_a_channel_without_light_cannot_be_solved(tmp_path):
    write_capture(tmp_path, SCENE)
    for index, direction in enumerate(ring(4).tolist()):
        edit_frame(tmp_path, index, light={"type": "distant", "direction": direction, "irradiance": [1, 0, 1]})
    with pytest.raises(ManifestError, match="channel G is 0 for every light"):
        check_solvable(Capture.open(tmp_path))


def test_other_lights_cannot_be_taken_for_distant_ones(tmp_path):
    write_capture(tmp_path, SCENE)
    edit_frame(tmp_path, 2, light={"type": "point", "position_m": [0, 0, 1], "intensity": [1, 1, 1]})
    with pytest.raises(ManifestError, match=r"frames\[2\]\.light: is point: this needs distant lights"):
        distant_lights(Capture.open(tmp_path))
    for index in range(4):
        edit_frame(tmp_path, index, light={"type": "off"})
    with pytest.raises(ManifestError, match="none is lit by a distant light"):
        distant_lights(Capture.open(tmp_path))


def perspective(**changes):
    fields = {"projection": "perspective", "resolution": (40, 30), "focal_px": (50.0, 55.0), "principal_px": (21.0, 14.0)}
    return Camera(**{**fields, **changes})


coefficient = st.floats(-0.05, 0.05)
tangential = st.floats(-0.005, 0.005)
plane = st.floats(-0.5, 0.5)


@pytest.mark.long
@settings(deadline=None)
@given(k=st.tuples(coefficient, coefficient, coefficient), p=st.tuples(tangential, tangential), x=plane, y=plane)
def test_undo_is_the_inverse_of_apply(k, p, x, y):
    lens = Distortion(model="brown_conrady", k=k, p=p)
    x, y = np.array([x]), np.array([y])
    back = lens.undo(*lens.apply(x, y))
    # what the fixed point leaves after its iterations: its contraction is below 0.25 for these lenses, and 0.25^20 = 1e-12
    assert np.allclose(back, (x, y), rtol=0, atol=1e-12)


def test_distortion_is_opencvs():
    # cv::projectPoints' own formula, written out once more
    k1, k2, k3, p1, p2, x, y = 0.1, -0.02, 0.003, 0.004, -0.005, 0.3, -0.2
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    expected = (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
    lens = Distortion(model="brown_conrady", k=(k1, k2, k3), p=(p1, p2))
    assert np.allclose(lens.apply(np.array(x), np.array(y)), expected, rtol=1e-14)


@pytest.mark.filterwarnings("error")
def test_places_that_a_lens_cannot_have_are_far_beside_or_nothing():
    """Boards in the middle of an image left k2 = -2.1, which folds its corners: relit depth printed warnings of NumPy."""
    lens = Distortion(model="brown_conrady", k=(0.05, -2.1, 0.0))
    x, y = lens.undo(np.array([0.1, 0.8, -3.0]), np.array([0.05, 0.6, 2.0]))
    assert np.allclose([part[0] for part in lens.apply(x[:1], y[:1])], (0.1, 0.05))
    assert not ((np.abs(x[1:]) <= 1) & (np.abs(y[1:]) <= 1)).any()
    assert not np.isinf((x * y).astype(np.float32)).any()  # later steps raise no warning either


@pytest.mark.parametrize("camera", [
    perspective(distortion=Distortion(model="brown_conrady", k=(-0.1, 0.02, 0.0), p=(0.001, -0.002))), perspective(principal_px=None),
    Camera(projection="orthographic", resolution=(40, 30), pixel_size_m=0.01, principal_px=(3.0, 8.5)),
    Camera(projection="orthographic", resolution=(40, 30))])
def test_points_are_seen_at_their_pixels(camera):
    u, v = np.meshgrid(np.arange(40) + 0.5, np.arange(30) + 0.5)
    points = camera.points(np.linspace(-3, -2, 1200).reshape(30, 40))
    assert np.allclose(camera.image_coordinates(points), (u, v), rtol=0, atol=2e-5)  # float32 points
    row, col, inside = camera.pixels_of(points.reshape(-1, 3))
    assert inside.all() and np.array_equal(row * 40 + col, np.arange(1200))
    beyond = camera.pixels_of(points.reshape(-1, 3) * [100, 100, 1])[2].reshape(30, 40)
    assert not beyond[[0, -1]].any() and (camera.projection == "orthographic" or not camera.pixels_of(-points.reshape(-1, 3))[2].any())


def test_perspective_points_lie_on_their_rays_in_front_of_the_camera():
    points = perspective().points(np.full((30, 40), -2.0))
    assert points.dtype == np.float32
    # pixel (row 3, column 5) is at u, v = 5.5, 3.5; above the principal point is up, left of it is -x
    assert np.allclose(points[3, 5], (2 * (5.5 - 21) / 50, -2 * (3.5 - 14) / 55, -2), rtol=1e-6)


def test_orthographic_points_are_metric_or_in_pixels():
    metric = Camera(projection="orthographic", resolution=(4, 2), pixel_size_m=0.01)
    assert metric.metric
    assert np.allclose(metric.points(np.zeros((2, 4)))[0, 3], (0.015, 0.005, 0))
    bare = Camera(projection="orthographic", resolution=(4, 2))
    assert not bare.metric
    assert np.allclose(bare.points(np.ones((2, 4)))[1, 0], (-1.5, -0.5, 1))


@pytest.mark.parametrize("camera", [
    perspective(), perspective(distortion=Distortion(model="brown_conrady", k=(-0.1, 0.02, 0.0), p=(0.001, -0.002))),
    Camera(projection="orthographic", resolution=(40, 30), pixel_size_m=0.01, principal_px=(3.0, 8.5))])
def test_rows_and_pixels_of_the_image_are_those_of_the_whole(camera):
    height = -1 - np.arange(1200.0).reshape(30, 40) / 1200
    for rows, whole in zip(camera.plane_views(7, 5), camera.plane_coordinates(), strict=True):
        np.testing.assert_array_equal(rows, whole[7:12])
    whole, pixels = camera.points(height), np.array([0, 6, 612, 1199])
    np.testing.assert_array_equal(camera.points(height[7:], 7), whole[7:])
    np.testing.assert_array_equal(camera.points_at(pixels, height.reshape(-1)[pixels]), whole.reshape(-1, 3)[pixels])


@pytest.mark.parametrize(("changes", "words"), [
    ({"focal_px": None}, "focal_px is missing"),
    ({"pixel_size_m": 0.1}, "pixel_size_m is for orthographic"),
    ({"surface_z_m": 1.0}, "must be negative"),
    ({"projection": "orthographic"}, "focal_px is for perspective"),
    ({"resolution": (0, 3)}, "resolution"),
    ({"focal_px": (0.0, 1.0)}, "focal_px"),
    ({"projection": "fisheye"}, "projection"),
    ({"focal": 3}, "focal"),
])
def test_contradictions_are_refused(changes, words):
    with pytest.raises(ValidationError, match=words):
        perspective(**changes)
