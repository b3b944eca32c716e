"""Images under one far light each with a table of the lights: every kind of table, and every convention of its axes."""

import json
from itertools import product

import numpy as np
import pytest
from scipy.io import savemat

from stage.capture.capture import Capture
from stage.errors import ManifestError
from stage.importers.camera_options import WAYS, Selection
from stage.importers.olat import import_folder
from tests.scenes.captures import nothing_written, write_image

DIRECTIONS = np.array([(0, 0, 1), (0.6, 0, 0.8), (0, 0.6, 0.8), (-0.48, -0.36, 0.8)])
STRENGTHS = np.array([(1, 1, 1), (2, 1, 0.5), (0.5, 1, 2), (1.5, 1.5, 1.5)])
NAMES = [f"IMG_{number}.JPG" for number in (2, 9, 10, 11)]  # as cameras write them; text order would be 10, 11, 2, 9
OURS = ("right", "up", "towards")


@pytest.fixture
def folder(tmp_path):
    for number, name in enumerate(NAMES):
        write_image(tmp_path / "coin" / name, np.full((4, 5, 3), 40 * (number + 1), np.uint8))
    return tmp_path / "coin"


def lights_of(folder, path, **choices):
    """What a manifest says of the lights: names, directions and irradiances."""
    import_folder(folder, folder, lights=path, **{"axes": OURS, "to_light": True, **choices})
    frames = Capture.open(folder).manifest.frames
    return ([frame.image for frame in frames], np.array([frame.light.direction for frame in frames]),
            np.array([frame.light.irradiance for frame in frames]))


def rows(*columns, separator=" "):
    return "".join(separator.join(f"{value:g}" if isinstance(value, float) else value for value in row) + "\n"
                   for row in zip(*columns, strict=True))


X, Y, Z = (list(map(float, column)) for column in DIRECTIONS.T)
R, G, B = (list(map(float, column)) for column in STRENGTHS.T)
TEXTS = {
    "lights.txt": "4\n" + rows(X, Y, Z),  # the University of Washington's data: a count, then the directions
    "commas.csv": "# dome of 2019\n" + rows(X, Y, Z, separator=","),
    "semicolons.csv": "x;y;z\n" + rows(X, Y, Z, separator=";"),
    "named.csv": "Image,X,Y,Z\n" + rows(NAMES, X, Y, Z, separator=","),
    "other_order.csv": "\ufeffz,image,lx,ly\n" + rows(Z, [f"C:\\dome\\{name}" for name in NAMES], X, Y, separator=","),
    "decimal_commas.csv": "Light;X;Y;Z\n" + rows(["L1", "L2", "L3", "L4"], X, Y, Z, separator=";").replace(".", ","),
    "quoted.csv": "Bild,x,y,z\n" + "".join(f'"{name}","{x}","{y}","{z}"\n' for name, x, y, z in zip(
        NAMES, *([f"{value:g}".replace(".", ",") for value in column] for column in (X, Y, Z)), strict=True)),
    "text_order.csv": "photo,x,y,z\n" + rows(NAMES[2:] + NAMES[:2], X[2:] + X[:2], Y[2:] + Y[:2], Z[2:] + Z[:2], separator=","),
    "counted.csv": "i,x,y,z\n" + rows(["1", "2", "3", "4"], X, Y, Z, separator=","),
    "counted.txt": rows(X, Y, Z, ["0", "1", "2", "3"]),
    "numbered.csv": "id,x,y,z\n" + rows(["1", "2", "3", "4"], X, Y, Z, separator=","),
    "numbered.txt": rows(["0", "1", "2", "3"], X, Y, Z),
    "millimetres.csv": "file,x_mm,y_mm,z_mm\n" + rows(NAMES, *([1000 * value for value in column] for column in (X, Y, Z)), separator=","),
    "dome.lp": "4\n" + rows([name.replace(".JPG", ".tif") for name in NAMES], X, Y, Z),  # stems: the images were converted since
}


@pytest.mark.parametrize("name", TEXTS)
def test_a_table_of_text(folder, name):
    path = folder / name
    path.write_text(TEXTS[name], encoding="utf-8")
    images, directions, irradiance = lights_of(folder, path)
    order = [images.index(name) for name in NAMES]
    assert np.allclose(directions[order], DIRECTIONS) and np.all(irradiance == 1)
    assert Capture.open(folder).manifest.irradiance_scale == "relative"


@pytest.mark.parametrize(("encoding", "name"), [("cp1252", "Münze.jpg"), ("utf-16", "Münze.jpg"), ("utf-8", "Mu\u0308nze.jpg")])
def test_names_with_umlauts_as_windows_and_macos_write_them(folder, encoding, name):
    (folder / NAMES[0]).rename(folder / name)
    (folder / "lights.csv").write_text("image,x,y,z\n" + rows(["Münze.jpg", *NAMES[1:]], X, Y, Z, separator=","), encoding=encoding)
    assert lights_of(folder, None)[0] == [name, *NAMES[1:]]


def test_a_plane_of_lamps_at_one_height_is_no_table_of_angles(folder):
    for side in (200, 2):
        (folder / "lights.csv").write_text(f"x,y,z\n-{side},-1,1.75\n{side},-1,1.75\n-{side},1,1.75\n{side},1,1.75\n")
        assert len(lights_of(folder, None)[0]) == 4


def test_lights_in_columns(folder):
    """What MATLAB's save -ascii makes of a 3 x n matrix; 3 x 4 might be three lights with strengths too, and is asked for."""
    path = folder / "L.txt"
    path.write_text("".join(" ".join(f"{value:.7e}" for value in row) + "\n" for row in DIRECTIONS.T))
    with pytest.raises(ManifestError, match="is 3 x 4: say with --lights-in"):
        lights_of(folder, path)
    assert np.allclose(lights_of(folder, path, run="columns")[1], DIRECTIONS)


@pytest.mark.parametrize("text", [rows(X, Y, Z, R, G, B), "image,x,y,z,r,g,b\n" + rows(NAMES, X, Y, Z, R, G, B, separator=","),
                                  "x\ty\tz\tintensity_r\tintensity_g\tintensity_b\n" + rows(X, Y, Z, R, G, B, separator="\t")])
def test_a_table_with_strengths(folder, text):
    path = folder / "table.txt"
    path.write_text(text)
    _, directions, irradiance = lights_of(folder, path)
    assert np.allclose(directions, DIRECTIONS) and np.allclose(irradiance, STRENGTHS)


@pytest.mark.parametrize("content", [
    DIRECTIONS.tolist(),
    {"light_directions": DIRECTIONS.tolist()},
    {"lights": [{"image": name, "direction": list(row)} for name, row in zip(NAMES[::-1], DIRECTIONS[::-1].tolist(), strict=True)]},
    [{"x": x, "y": y, "z": z} for x, y, z in DIRECTIONS.tolist()],
    dict(zip(NAMES, DIRECTIONS.tolist(), strict=True)),
])
def test_json(folder, content):
    path = folder / "lights.json"
    path.write_text(json.dumps(content))
    images, directions, _ = lights_of(folder, path)
    assert sorted(images) == sorted(NAMES)
    for name, direction in zip(images, directions, strict=True):
        assert np.allclose(direction, DIRECTIONS[NAMES.index(name)])


@pytest.mark.parametrize(("variables", "choices"), [
    ({"L": DIRECTIONS}, {}), ({"L": DIRECTIONS.T}, {}), ({"L": DIRECTIONS, "mask": np.ones((9, 9))}, {}),
    ({"L": DIRECTIONS, "E": STRENGTHS}, {"variable": "L"}), ({"rig": {"light": DIRECTIONS.T}}, {"variable": "rig.light"}),
])
def test_matlab(folder, variables, choices):
    savemat(folder / "light.mat", variables)
    assert np.allclose(lights_of(folder, None, **choices)[1], DIRECTIONS)  # the only table in the folder


def test_strengths_of_a_file_of_their_own(folder):
    path, strengths = folder / "dirs.txt", folder / "strengths.txt"
    path.write_text(rows(X, Y, Z))
    strengths.write_text(rows(R))
    assert np.allclose(lights_of(folder, path, strengths=strengths)[2], STRENGTHS[:, :1])


@pytest.mark.parametrize("to_light", [True, False])
@pytest.mark.parametrize("axes", [axes for axes in product(WAYS, repeat=3)
                                  if sorted(np.abs([WAYS[way] for way in axes]).argmax(axis=1)) == [0, 1, 2]][::5], ids=",".join)
def test_every_convention_of_the_axes_comes_out_in_the_camera_frame(folder, axes, to_light):
    path = folder / "dirs.txt"
    there = np.array([[np.dot(direction, WAYS[way]) for way in axes] for direction in DIRECTIONS]) * (1 if to_light else -1)
    path.write_text(rows(*map(list, there.astype(float).T)))
    assert np.allclose(lights_of(folder, path, axes=axes, to_light=to_light)[1], DIRECTIONS)


def test_what_was_understood_is_told(folder):
    (folder / "dirs.txt").write_text(rows(X, Y, Z))
    write_image(folder / "coin_mask.png", np.full((4, 5), 255, np.uint8))
    write_image(folder / "ambient.JPG", np.zeros((4, 5, 3), np.uint8))
    imported = import_folder(folder, folder, axes=("right", "down", "away"), to_light=False)
    facts = dict(imported.facts)
    assert facts["axes"].startswith("x right, y down, z away from the camera") and facts["axes"].endswith("from the light")
    assert facts["side"].startswith("4 lights stand on the camera's side") and facts["mask"] == "coin_mask.png"
    assert "in the order of the images, IMG_2.JPG to IMG_11.JPG" in facts["lights"] and "srgb_texture" in facts["colour"]
    frames = Capture.open(folder).manifest.frames
    assert (frames[-1].image, frames[-1].light.type) == ("ambient.JPG", "off") and len(frames) == 5
    assert "mirrors" not in facts["axes"] and dict(import_folder(folder, folder, axes=("right", "down", "towards"), to_light=True).facts)[
        "axes"].startswith("x right, y down, z towards the camera (left-handed)")


@pytest.mark.parametrize(("text", "choices", "words"), [
    ("0 0 1\n0 up 1\n", {}, r"dirs\.txt: line 2: '0 up 1' is not three numbers"),
    ("0 0 1\n0 1\n", {}, "line 2: has another count of numbers than the first line, 3"),
    ("0 0 1\n0 0 1\n0 0 0\n0 0 1\n", {"run": "rows"}, r"dirs\.txt: line 3: 0 0 0 is no direction"),
    ("0 0 1\n0 1 0\n1 0 0\n", {}, "is 3 x 3: say with --lights-in"),
    ("5\n" + rows(X, Y, Z), {}, r"dirs\.txt: says 5 lights, holds 4"),
    ("1 2\n3 4\n", {}, "has 2 rows of 2 numbers: a light has three"),
    ("azimuth,elevation\n1,2\n", {}, "has the headings azimuth, elevation: there must be x, y and"),
    ("image,x,y,z\na.jpg,1,2\n", {}, r"line 2: 'a\.jpg 1 2' lacks a value"),
    (rows(X[:2], Y[:2], Z[:2]), {}, r"2 lights, the folder 4 images \(IMG_2\.JPG to IMG_11\.JPG\)"),
    ("image,x,y,z\nno.jpg,0,0,1\n", {}, r"dirs\.txt: names no\.jpg, which is no image in the folder"),
    ("image,x,y,z\nIMG_2.JPG,0,0,1\nIMG_2.JPG,0,1,1\n", {}, r"line 3: names IMG_2\.JPG a second time"),
    ("id,x,y,z\n" + rows(["4", "2", "3", "1"], X, Y, Z, separator=","), {}, r"numbers its lights 4, 2, 3, 1"),
    (rows(["4", "2", "3", "1"], X, Y, Z), {}, r"numbers its lights 4, 2, 3, 1"),
    ("-120 40 1\n30 60 1\n95 12 1\n170 80 1\n", {}, r"dirs\.txt: its columns look like two angles and a radius of 1"),
    ("120 40 350\n30 60 350\n195 12 350\n270 80 350\n", {}, r"dirs\.txt: its columns look like two angles and a radius of 350"),
    ('x,y,z\n"1,200","350","80"\n"-900","1,100","70"\n0,0,"1,500"\n0,-10,999\n', {}, r"dirs\.txt: holds 1,200, which may be a thousand"),
    ("0.7 -1.2 1\n1.1 0.4 1\n0.2 2.9 1\n0.6 -3 1\n", {"run": "rows"}, r"dirs\.txt: its columns look like two angles and a radius of 1"),
    ("".join(f"{name},0,05,0,5,0,8\n" for name in NAMES), {}, "line 1: has 7 cells: part columns by semicolons where numbers"),
    ("image,x,y,z\nIMG_2.JPG,0,5,0,3,0,8\n", {}, "line 2: has 7 cells under 4 headings: part columns by semicolons"),
    (rows(["1", "2", "4", "5"], X, Y, Z), {}, "its first column numbers the lights 1, 2, 4, 5 … with gaps"),
    ("", {}, r"dirs\.txt: holds no light"),
    (rows(X, Y, Z), {"axes": ("right", "left", "up")}, "two of them lie on one line"),
])
def test_faults_are_named_and_nothing_is_written(folder, text, choices, words):
    (folder / "dirs.txt").write_text(text)
    with nothing_written(folder, words, ManifestError):
        lights_of(folder, folder / "dirs.txt", **choices)


def test_no_table_or_several(folder):
    with pytest.raises(ManifestError, match="no table of lights: name that of the lights with --lights"):
        lights_of(folder, None)
    for name in ("a.txt", "b.csv"):
        (folder / name).write_text(rows(X, Y, Z))
    with pytest.raises(ManifestError, match=r"holds a\.txt, b\.csv: name that of the lights with --lights"):
        lights_of(folder, None)


def test_images_chosen_by_name(folder):
    (folder / "dirs.txt").write_text(rows(X[:2], Y[:2], Z[:2]))
    assert lights_of(folder, folder / "dirs.txt", selection=Selection(images="IMG_1*"))[0] == NAMES[2:]
    with pytest.raises(ManifestError, match="holds no image that IMG_3"):
        lights_of(folder, folder / "dirs.txt", selection=Selection(images="IMG_3*"))
    with pytest.raises(ManifestError, match=r"--mask m\.png: there is no such image"):
        lights_of(folder, folder / "dirs.txt", selection=Selection(mask="m.png"))


def test_a_manifest_that_is_replaced_by_another_is_kept(folder):
    """The folder may be written into without being named, and somebody may have worked on its capture.json."""
    (folder / "table.txt").write_text(rows(X, Y, Z))
    lights_of(folder, folder / "table.txt")
    own = (folder / "capture.json").read_bytes().replace(b'"color_space"', b'"notes": "mine", "color_space"')
    (folder / "capture.json").write_bytes(own)
    lights_of(folder, folder / "table.txt")
    made = (folder / "capture.json").read_bytes()
    assert (folder / "capture.previous.json").read_bytes() == own != made
    lights_of(folder, folder / "table.txt")  # the same again keeps what was kept
    assert (folder / "capture.previous.json").read_bytes() == own
    assert (folder / "capture.json").read_bytes() == made


def test_what_is_assumed_of_the_encoding_is_kept_in_the_manifest(folder):
    (folder / "lights.txt").write_text(TEXTS["lights.txt"])
    import_folder(folder, folder, axes=OURS, to_light=True)
    capture = Capture.open(folder)
    assert capture.manifest.assumed[0].startswith("color_space: the images have 8 bits and were taken as sRGB")
    assert capture.doubts == capture.manifest.assumed  # so that info and reports repeat it
    import_folder(folder, folder, axes=OURS, to_light=True, color_space="lin_rec709_scene")
    assert Capture.open(folder).manifest.assumed == ()
