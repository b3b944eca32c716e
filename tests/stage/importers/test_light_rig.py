"""Rigs of near lights and RelightLab's files: the values that reach the manifest, and faults by name."""

import json

import numpy as np
import pytest
from scipy.io import savemat

from stage.capture.capture import Capture
from stage.errors import ManifestError
from stage.importers import olat, relightlab
from stage.importers.camera_options import View
from stage.importers.light_rig import read_camera_matrix
from tests.scenes.captures import nothing_written, write_image

S = np.array([(-100.0, -80, 0), (100, -80, 10), (100, 80, 0), (-100, 80, 20.0)])
DIR = np.array([(0.2, 0.1, 1.0), (-0.2, 0.1, 1), (-0.2, -0.1, 1), (0.2, -0.1, 1)])
DIR /= np.linalg.norm(DIR, axis=1, keepdims=True)
PHI, MU = np.array([(1.0, 2, 3), (2, 2, 2), (3, 2, 1), (1, 1, 1)]), np.array([1.0, 0.5, 2.0, 0.0])
NAMES = [f"led{number}.png" for number in range(4)]
CHOICES = {"axes": ("right", "down", "away"), "unit_m": 0.001}


@pytest.fixture
def folder(tmp_path):
    for name in NAMES:
        write_image(tmp_path / "rig" / name, np.full((4, 6, 3), 900, np.uint16))
    return tmp_path / "rig"


def lights_of(folder, **choices):
    olat.import_near_lights(folder, folder, **{**CHOICES, **choices})
    return [frame.light for frame in Capture.open(folder).manifest.frames]


@pytest.mark.parametrize("kind", ["mat", "mat of a structure", "json of arrays", "json of lights"])
def test_every_kind_of_rig(folder, kind):
    values = {"S": S, "Dir": DIR, "Phi": PHI, "mu": MU}
    if kind.startswith("mat"):
        savemat(folder / "light.mat", values if kind == "mat" else {"calib": {name: value.T for name, value in values.items()}})
    elif kind == "json of arrays":
        names = {"S": "positions", "Dir": "directions", "Phi": "intensities", "mu": "mu"}
        (folder / "light.json").write_text(json.dumps({names[name]: value.tolist() for name, value in values.items()}))
    else:
        (folder / "light.json").write_text(json.dumps({"lights": [
            {"image": name, "position": s, "direction": d, "intensity": p, "mu": m}
            for name, s, d, p, m in zip(NAMES[::-1], S[::-1].tolist(), DIR[::-1].tolist(), PHI[::-1].tolist(), MU[::-1], strict=True)]}))
    found = lights_of(folder)
    flip = np.array([1, -1, -1])
    order = slice(None, None, -1 if kind == "json of lights" else 1)
    assert np.allclose([light.position_m for light in found][order], 0.001 * S * flip)
    assert np.allclose([light.intensity for light in found][order], PHI)
    assert [light.anisotropy for light in found][order] == [1.0, 0.5, 2.0, None]
    assert np.allclose([light.axis for light in found[order][:3]], (DIR * flip)[:3]) and found[order][3].axis is None


@pytest.mark.parametrize(("values", "words"), [
    ({"Phi": PHI}, r"light\.mat: holds phi: there must be positions"),
    ({"S": S[:, :2]}, r"light\.mat: s: is 4 x 2, must be n x 3"),
    ({"S": S, "Phi": PHI[:3]}, r"phi: is 3 x 3, must be 4 x 1 or 3 finite numbers"),
    ({"S": S, "mu": MU}, r"mu is above 0, but there are no directions of the lights"),
    ({"S": S, "mu": -MU, "Dir": DIR}, "mu of light 1 is negative"),
    ({"S": S * np.nan}, "s: is 4 x 3, must be n x 3 finite numbers"),
    ({"S": S[:3]}, r"has 3 lights, the folder 4 images"),
])
def test_faults_of_a_rig(folder, values, words):
    savemat(folder / "light.mat", values)
    with nothing_written(folder, words, ManifestError):
        lights_of(folder)


def test_the_centre_of_the_first_pixel_is_that_of_the_program(tmp_path):
    k = np.array([[700.0, 0, 320], [0, 710, 240], [0, 0, 1]])
    savemat(tmp_path / "camera.mat", {"K": k})
    (tmp_path / "camera.json").write_text(json.dumps({"camera_matrix": k.tolist(), "dist": [[0.1, 0, 0, 0, 0]]}))
    assert read_camera_matrix(tmp_path / "camera.mat", (640, 480)).principal_px == (319.5, 239.5)
    found = read_camera_matrix(tmp_path / "camera.json", (640, 480))
    assert found.principal_px == (320.5, 240.5) and found.distortion.k == (0.1, 0, 0)


def test_the_size_of_the_images_that_a_file_says(tmp_path):
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"camera_matrix": [[700, 0, 320], [0, 710, 240], [0, 0, 1]], "image_width": 640, "image_height": 480}))
    assert read_camera_matrix(path, (640, 480)).focal_px == (700, 710)
    with pytest.raises(ManifestError, match=r"camera\.json: is of a camera of 640x480 px, this one has 1280x960"):
        read_camera_matrix(path, (1280, 960))


def test_a_camera_that_does_not_fit(folder):
    savemat(folder / "light.mat", {"S": S})
    savemat(folder.parent / "camera.mat", {"K": np.array([[700.0, 0, 320], [0, 710, 240], [0, 0, 1]])})
    with pytest.raises(ManifestError, match="outside the images of 6x4 pixels: it belongs to another"):
        lights_of(folder, camera=folder.parent / "camera.mat")
    with pytest.raises(ManifestError, match="give one of both"):
        lights_of(folder, camera=folder.parent / "camera.mat", view=View(focal_px=(700.0,)))


def dome(**changes):
    def of(rows, names="xyz"):
        return [dict(zip(names, row, strict=True)) for row in rows.tolist()]

    return {"label": "d", "imageWidth": 60.0, "domeDiameter": 400.0, "lightConfiguration": "directional", "directions": of(DIR),
            "positionsSphere": of(200 * DIR), "positions3d": of(210 * DIR), "ledAdjust": [], **changes}


@pytest.mark.parametrize(("configuration", "factor"), [("directional", None), ("spherical", 0.2), ("lights3d", 0.21)])
def test_a_dome_lights_images_in_their_order(folder, configuration, factor):
    (folder / "rig.dome").write_text(json.dumps(dome(lightConfiguration=configuration)))
    relightlab.import_folder(folder, None)
    capture = Capture.open(folder)
    lights = [frame.light for frame in capture.manifest.frames]
    assert [frame.image for frame in capture.manifest.frames] == NAMES and capture.camera.pixel_size_m == pytest.approx(0.01)
    if factor is None:
        assert np.allclose([light.direction for light in lights], DIR)
    else:
        assert np.allclose([light.position_m for light in lights], factor * DIR)


@pytest.mark.parametrize("aligns", [[], [{"rect": [0, 0, 8, 8], "offsets": []}]])
def test_images_that_a_project_aligns_are_said_to_be_as_they_are(folder, aligns):
    images = [{"filename": name, "skip": False} for name in NAMES]
    (folder / "coin.relight").write_text(json.dumps({"folder": ".", "images": images, "dome": dome(), "aligns": aligns}))
    relightlab.import_folder(folder / "coin.relight", None)
    assert any("lie on one another" in said for said in Capture.open(folder).manifest.assumed) == bool(aligns)


def test_positions_without_a_width_are_directions(folder):
    (folder / "rig.dome").write_text(json.dumps(dome(lightConfiguration="lights3d", imageWidth=0)))
    relightlab.import_folder(folder, None)
    assert {frame.light.type for frame in Capture.open(folder).manifest.frames} == {"distant"}


@pytest.mark.parametrize(("content", "words"), [
    ("[1", r"rig\.dome: is not JSON"), ("[]", "must hold one JSON object"), (json.dumps({}), r"dome\.directions: is missing|images\[\]"),
    (json.dumps(dome(lightConfiguration="lights3d", imageWidth=0, directions=[])), r"dome\.imageWidth: is not set"),
    (json.dumps(dome(directions=[{"x": 0, "y": 0, "z": 1}])), r"dome\.directions: has 1 entries for 4 images"),
    (json.dumps(dome(directions=[{"x": 0, "y": 0, "z": 0}] * 4)), r"led0\.png has no light direction: find it in RelightLab"),
    (json.dumps(dome(directions=[[0, 0, 1]] * 4)), r"dome\.directions: each must have the numbers x, y, z"),
    (json.dumps(dome(ledAdjust=[{"r": 0, "g": 1, "b": 1}] * 4)), r"ledAdjust: holds a factor that is not above 0"),
    (json.dumps(dome(imageWidth="wide")), r"dome\.imageWidth: is wide"),
])
def test_faults_of_a_dome(folder, content, words):
    (folder / "rig.dome").write_text(content)
    with nothing_written(folder, words, ManifestError):
        relightlab.import_folder(folder, None)


HUGE = "1" + "0" * 400


@pytest.mark.parametrize("content", [f"[[1,0,0],[0,1,0],[0,0,{HUGE}],[0,0,1]]", "[[[1]],[2],[3],[4]]", "[null,null,null,null]",
                                     '{"a": 1}', '{"lights": [{"direction": [1, 2, 1e999]}]}', '{"lights": [{"position": {"x": "1"}}]}',
                                     '{"S": [[1e999,0,0]], "images": []}', f'{{"S": [[{HUGE},0,0]]}}', "3", '"S"', "[[]]", "{}"])
def test_numbers_that_are_none_are_one_sentence(folder, content):

    (folder / "light.json").write_text(content)
    for read in (lambda: lights_of(folder), lambda: olat.import_folder(folder, folder, axes=("right", "up", "towards"), to_light=True)):
        with pytest.raises(ManifestError, match=r"light\.json") as caught:
            read()
        assert "\n" not in str(caught.value)
    (folder / "light.json").rename(folder / "rig.dome")
    with pytest.raises(ManifestError, match=r"rig\.dome"):
        relightlab.import_folder(folder, None)
