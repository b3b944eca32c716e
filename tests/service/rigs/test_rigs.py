"""Rigs checked and planned, and made from scenes in MVR and GDTF."""

import csv
import io
import json
import sys
import zipfile

import numpy as np
import pytest

from stage.rig.patch import patch_faults
from stage.rig.rig import read_rig
from stage.transforms import fibonacci_sphere
from tests.scenes.rigs import write_rig, write_sky
from tests.service.owl import write_small_owl

IDENTITY = "{1,0,0}{0,1,0}{0,0,1}"
LUMINANCE = (0.2126, 0.7152, 0.0722)
EMITTERS = """<Emitter Name="Red LED" Color="0.64,0.33,20"/><Emitter Name="Green LED" Color="0.17,0.7,60"/>
<Emitter Name="Blue LED" Color="0.15,0.06,10"/><Emitter Name="White LED" Color="0.3127,0.329,100"/>"""


@pytest.mark.long
def test_a_rig_is_made_of_a_capture(relit, tmp_path):
    """Directions and irradiances are those of the manifest; each lamp has channels of its own."""
    capture = write_small_owl(tmp_path / "owl", 4)
    relit.done("rig", "from-capture", capture, "--out", tmp_path / "rig.json", "--universe", "5")
    rig = read_rig(tmp_path / "rig.json")
    lit = [frame for frame in json.loads((capture / "capture.json").read_text())["frames"] if frame["light"]["type"] == "distant"]
    assert rig.directions == pytest.approx(np.array([frame["light"]["direction"] for frame in lit]), abs=1e-6)
    assert [sum(p.irradiance[c] for p in lamp.primaries) for lamp in rig.lights for c in range(3)] == pytest.approx(
        [value for frame in lit for value in frame["light"]["irradiance"]])
    outcome = relit.done("rig", "check", tmp_path / "rig.json", "--picture", tmp_path / "dome.png")
    assert "sacn 5: 510 channels" in outcome.out and (tmp_path / "dome.png").stat().st_size > 1000


def test_check_names_what_is_wrong(relit, tmp_path):
    content = write_rig(tmp_path / "rig.json", fibonacci_sphere(40)[:8])
    content["lights"][3]["address"] = content["lights"][2]["address"]
    (tmp_path / "rig.json").write_text(json.dumps(content))
    outcome = relit("rig", "check", tmp_path / "rig.json")
    assert outcome.code == 2 and "lights[3].address.channels.red" in outcome.err
    assert "of the sphere" in outcome.out + outcome.err  # lamps on one side only


def test_a_rig_is_made_of_a_table(relit, tmp_path):
    (tmp_path / "dome.csv").write_text("name,x,y,z,universe,channel\nA,0,0,1,2,7\nB,0,3,4,2,11\n")
    relit.done("rig", "from-csv", tmp_path / "dome.csv", "--out", tmp_path / "rig.json", "--primaries", "white", "--bits", "16",
               "--protocol", "artnet", "--irradiance", "0.5")
    lamp = read_rig(tmp_path / "rig.json").lights[1]
    assert lamp.direction == pytest.approx((0, 0.6, 0.8)) and lamp.primaries[0].irradiance == (0.5, 0.5, 0.5)
    assert lamp.address is not None
    assert (lamp.address.protocol, lamp.address.universe, lamp.address.channels) == ("artnet", 2, {"white": 11})


@pytest.mark.parametrize("text, named", [
    ("name,x,y\nA,0,0\n", "column z"),
    ("name,x,y,z\nA,0,0,up\n", "line 2: z"),
    ("name,x,y,z\nA,0,0,0\n", "line 2: direction"),
    ("name,x,y,z,channel\nA,0,0,1,3\n", "universe"),
    ("name,x,y,z\nA,0,0,1\nA,0,1,1\n", "lights[1].name"),
    ("name,x,y,z\n", "lights"),
    ("name,x,y,z,universe,channel\nA,0,0,1,1.5,3\n", "line 2: universe"),
    ("name,x,y,z\nA,0,60,1.2\nB,120,45,1.2\nC,-120,60,1.2\nD,170,10,1.2\n", "two angles"),
    ("name,x,y,z\nA,0,0,1\nB,0,6,0,0,8\n", "line 3: has 6 cells, the first line names 4 columns"),
])
def test_a_wrong_table_is_one_sentence(relit, tmp_path, text, named):
    (tmp_path / "dome.csv").write_text(text)
    relit("rig", "from-csv", tmp_path / "dome.csv", "--out", tmp_path / "rig.json").refused(named)
    assert not (tmp_path / "rig.json").exists()


@pytest.mark.parametrize("table", ["name;x;y;z\nA;0;0;1\nB;0,6;0;0,8\n", "Name\tX\tY\tZ\nA\t0\t0\t1\nB\t0.6\t0\t0.8\n",
                                   "name,x,y,z\nA,0,0,1,,\n\nB,0.6,0,0.8, \n"],
                         ids=["semicolons", "tabs", "empty cells behind the columns"])
def test_a_table_may_have_decimal_commas_or_empty_cells(relit, tmp_path, table):
    (tmp_path / "dome.csv").write_text(table)
    relit.done("rig", "from-csv", tmp_path / "dome.csv", "--out", tmp_path / "rig.json")
    assert json.loads((tmp_path / "rig.json").read_text())["lights"][1]["direction"] == pytest.approx([0.6, 0, 0.8])


def test_lamps_of_one_place_and_places_in_millimetres_are_said(relit, tmp_path):
    (tmp_path / "dome.csv").write_text("name,x,y,z\nA,0,0,1500\nB,900,0,1200\nC,900,0,1200\n")
    relit.done("rig", "from-csv", tmp_path / "dome.csv", "--out", tmp_path / "rig.json", "--places")
    shown = relit.done("rig", "check", tmp_path / "rig.json").out
    assert "B and C stand in one direction" in shown and "lights[].position_m: the lamps stand 1.5e+03 m" in shown
    assert "lights: all lamps stand behind" not in shown
    (tmp_path / "dome.csv").write_text("name,x,y,z\nA,0,0,-1\nB,0.6,0,-0.8\n")
    relit.done("rig", "from-csv", tmp_path / "dome.csv", "--out", tmp_path / "rig.json")
    assert "lights: all lamps stand behind" in relit.done("rig", "check", tmp_path / "rig.json").out


@pytest.mark.parametrize(("unit", "said"), [(1, True), (1000, False)], ids=["metres", "millimetres"])
def test_a_scene_in_metres_is_said(relit, tmp_path, unit, said):
    """Places of MVR are millimetres."""
    places = [f"{2 * unit},{3 * unit},{4 * unit}", f"{-2 * unit},{3 * unit},{4 * unit}"]
    (tmp_path / "scene.mvr").write_bytes(mvr("".join(fixture(f"L{at}", "Par", "RGB 8 bit", place, 1 + 9 * at) for at, place
                                                     in enumerate(places)), Par=RGB))
    relit.done("rig", "from-mvr", tmp_path / "scene.mvr", "--out", tmp_path / "rig.json")
    shown = relit.done("rig", "check", tmp_path / "rig.json").out
    assert ("the lamps stand 0.00539 m from the subject (median): are the places of the scene metres" in shown) == said


def test_more_lamps_plan_a_smaller_error(relit, tmp_path):
    write_sky(tmp_path / "sky.exr", "sun", rows=32)
    write_rig(tmp_path / "rig.json", fibonacci_sphere(64), name='the "new" dome')
    relit.done("rig", "plan", "--environment", tmp_path / "sky.exr", "--lights", "16,64,256", "--rig", tmp_path / "rig.json",
               "--out", tmp_path / "plan")
    with open(tmp_path / "plan" / "plan.csv", newline="") as file:
        *rows, given = csv.DictReader(file)
    assert given == {**rows[1], "rig": 'the "new" dome'}  # the same directions
    for column in ("irradiance_percent", "highlights_0.6_percent"):
        errors = [float(row[column]) for row in rows]
        assert errors == sorted(errors, reverse=True) and errors[-1] < 0.5 * errors[0]
    assert (tmp_path / "plan" / "plan.png").stat().st_size > 1000


def zipped(files: dict[str, bytes | str]) -> bytes:
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w") as package:
        for name, content in files.items():
            package.writestr(name, content)
    return whole.getvalue()


def channel(attribute: str, offset: str, geometry: str = "Body", emitter: str = "", dmx_break: str = "1", values: str = "",
            default: str = "0/1") -> str:
    link = f'Emitter="{emitter}"' if emitter else ""
    return (f'<DMXChannel DMXBreak="{dmx_break}" Offset="{offset}" Geometry="{geometry}" {values}><LogicalChannel Attribute="{attribute}">'
            f'<ChannelFunction Name="F" Attribute="{attribute}" DMXFrom="0/1" Default="{default}" {link}/></LogicalChannel></DMXChannel>')


def gdtf(mode: str, channels: str, *, emitters: str = "", geometries: str = '<Geometry Name="Body"/>') -> bytes:
    return zipped({"description.xml": f"""<?xml version="1.0" encoding="UTF-8"?><GDTF DataVersion="1.2"><FixtureType Name="Lamp">
<PhysicalDescriptions><Emitters>{emitters}</Emitters></PhysicalDescriptions><Geometries>{geometries}</Geometries>
<DMXModes><DMXMode Name="{mode}" Geometry="Body"><DMXChannels>{channels}</DMXChannels></DMXMode></DMXModes></FixtureType></GDTF>"""})


RGB = gdtf("RGB 8 bit", channel("ColorAdd_R", "1") + channel("ColorAdd_G", "2") + channel("ColorAdd_B", "3"))
RGBW = gdtf("RGBW 16 bit", "".join(channel(f"ColorAdd_{letter}", f"{at},{at + 1}", emitter=f"{name} LED") for letter, at, name in (
    ("R", 1, "Red"), ("G", 3, "Green"), ("B", 5, "Blue"), ("W", 7, "White"))) + channel("Dimmer", "9"), emitters=EMITTERS)
PIXELS = gdtf("Two pixels", "".join(channel(f"ColorAdd_{letter}", f"{at}", "Pixel", dmx_break="Overwrite")
                                    for at, letter in enumerate("RGB", 1)),
              geometries="""<Geometry Name="Body"><GeometryReference Name="Left" Geometry="Pixel"
Position="{1,0,0,-0.5}{0,1,0,0}{0,0,1,-0.1}{0,0,0,1}"><Break DMXOffset="1" DMXBreak="1"/></GeometryReference><GeometryReference Name="Right"
Geometry="Pixel" Position="{1,0,0,0.5}{0,1,0,0}{0,0,1,-0.1}{0,0,0,1}"><Break DMXOffset="4" DMXBreak="1"/></GeometryReference></Geometry>
<Geometry Name="Pixel"/>""")


def fixture(name: str, kind: str, mode: str, place: str, address: int | None, *, axes: str = IDENTITY, identity: str = "1") -> str:
    patch = "" if address is None else f'<Addresses><Address break="0">{address}</Address></Addresses>'
    spec = f"<GDTFSpec>{kind}</GDTFSpec>" if kind else ""
    return (f'<Fixture name="{name}" uuid="{name}"><Matrix>{axes}{{{place}}}</Matrix>{spec}<GDTFMode>{mode}</GDTFMode>'
            f"<FixtureID>{identity}</FixtureID>{patch}</Fixture>")


def mvr(children: str, **types: bytes) -> bytes:
    scene = f"""<?xml version="1.0" encoding="UTF-8"?><GeneralSceneDescription verMajor="1" verMinor="6"><Scene><Layers>
<Layer name="Layer" uuid="a"><ChildList>{children}</ChildList></Layer></Layers></Scene></GeneralSceneDescription>"""
    return zipped({"GeneralSceneDescription.xml": scene, **{f"{name}.gdtf": content for name, content in types.items()}})


def made(relit, folder, content: bytes, *options):
    (folder / "scene.mvr").write_bytes(content)
    outcome = relit.done("rig", "from-mvr", folder / "scene.mvr", "--out", folder / "rig.json", *options)
    return read_rig(folder / "rig.json"), outcome.out


def test_places_turn_from_z_up_to_y_up(relit, tmp_path):
    """A fixture 2 m to the right, 3 m behind the subject's place and 4 m up; the subject 1 m up."""
    rig, _ = made(relit, tmp_path, mvr(fixture("A", "Par", "RGB 8 bit", "2000,3000,4000", 1), Par=RGB), "--subject", "0,0,1")
    assert rig.lights[0].position_m == pytest.approx((2, 4, -3)) and rig.subject_m == pytest.approx((0, 1, 0))
    assert rig.directions[0] == pytest.approx(np.array([2, 3, -3]) / np.sqrt(22))


def test_an_8_bit_lamp_without_emitters_has_the_colours_of_the_standard(relit, tmp_path):
    """GDTF's nominal red, green and blue are those of Rec.709 to its three digits: together they are white."""
    rig, printed = made(relit, tmp_path, mvr(fixture("A", "Par", "RGB 8 bit", "0,0,4000", 600), Par=RGB), "--irradiance", "2")
    lamp = rig.lights[0]
    assert lamp.bits == 8 and [primary.name for primary in lamp.primaries] == ["red", "green", "blue"]
    assert np.array([primary.irradiance for primary in lamp.primaries]) == pytest.approx(2 * np.eye(3), abs=0.03)
    assert lamp.address is not None and lamp.address.protocol == "sacn"
    assert (lamp.address.universe, lamp.address.channels) == (2, {"red": 88, "green": 89, "blue": 90})
    assert "nominal" in printed


def test_a_16_bit_lamp_has_the_colours_of_its_emitters(relit, tmp_path):
    """Luminous shares are those of Y; green lies outside of Rec.709, which is said; the dimmer is held at full, which is said too."""
    rig, printed = made(relit, tmp_path, mvr(fixture("A", "Wash", "RGBW 16 bit", "0,0,4000", 11), Wash=RGBW), "--protocol", "artnet",
                        "--universe", "0")
    lamp = rig.lights[0]
    light = np.array([primary.irradiance for primary in lamp.primaries])
    assert light @ LUMINANCE == pytest.approx(np.array([20, 60, 10, 100]) / 190, rel=1e-3)
    assert light[0, 1:].max() < 0.01 * light[0, 0] and light[1, 0] == 0 and light[3] == pytest.approx(light[3].mean(), rel=1e-3)
    assert lamp.bits == 16 and lamp.address is not None and (lamp.address.protocol, lamp.address.universe) == ("artnet", 0)
    assert lamp.address.channels == {"red": 11, "green": 13, "blue": 15, "white": 17}
    assert [(held.name, held.channel, held.value) for held in lamp.address.fixed] == [("Dimmer", 19, 255)]
    assert "Wash.gdtf: green: the colour lies outside" in printed and "Wash.gdtf: Dimmer 255:" in printed


def test_measured_intensities_are_the_luminous_shares(relit, tmp_path):
    emitters = "".join(f'<Emitter Name="{name}" Color="0.3127,0.329,100"><Measurement LuminousIntensity="{candela}"/></Emitter>'
                       for name, candela in (("Warm", 300), ("Cool", 100)))
    channels = channel("ColorAdd_WW", "1", emitter="Warm") + channel("ColorAdd_CW", "2", emitter="Cool")
    tunable = gdtf("CCT", channels, emitters=emitters)
    rig, _ = made(relit, tmp_path, mvr(fixture("A", "Panel", "CCT", "0,0,4000", 1), Panel=tunable))
    assert [(primary.name, sum(np.multiply(primary.irradiance, LUMINANCE))) for primary in rig.lights[0].primaries] == [
        ("warm-white", pytest.approx(0.75, rel=1e-3)), ("cool-white", pytest.approx(0.25, rel=1e-3))]


def test_a_lamp_without_colours_is_white_and_shared_channels_are_left_out(relit, tmp_path):
    """Its fine channel does not follow the coarse one, so that it is driven with 8 bits."""
    copy = fixture("Copy", "Spot", "Basic", "0,0,4000", 1).replace("<Fixture ", '<Fixture multipatch="A" ')
    spot = gdtf("Basic", channel("Dimmer", "1,3") + channel("Pan", "2"))
    rig, printed = made(relit, tmp_path, mvr(fixture("A", "Spot", "Basic", "0,0,4000", 1) + copy, Spot=spot))
    assert [lamp.name for lamp in rig.lights] == ["A"] and rig.lights[0].bits == 8
    assert [primary.name for primary in rig.lights[0].primaries] == ["white"]
    assert "8 bits" in printed and "Copy: shares the channels" in printed and "Spot.gdtf: Pan 0:" in printed


def test_pixels_of_a_bar_are_lamps_at_their_places(relit, tmp_path):
    """The bar is turned by 90° about z, in a group that stands 1 m to the right: its local x is the scene's y."""
    bar = fixture("Bar", "Bar", "Two pixels", "0,0,2000", 101, axes="{0,1,0}{-1,0,0}{0,0,1}")
    group = f'<GroupObject name="G" uuid="g"><Matrix>{IDENTITY}{{1000,0,0}}</Matrix><ChildList>{bar}</ChildList></GroupObject>'
    rig, _ = made(relit, tmp_path, mvr(group, Bar=PIXELS))
    assert [lamp.name for lamp in rig.lights] == ["Bar.Left", "Bar.Right"]
    assert rig.lights[0].position_m == pytest.approx((1, 1.9, 0.5)) and rig.lights[1].position_m == pytest.approx((1, 1.9, -0.5))
    assert [lamp.address.channels["red"] for lamp in rig.lights if lamp.address is not None] == [101, 104]


def test_channels_of_no_primary_are_held_at_what_lets_the_lamp_shine(relit, tmp_path):
    """A master dimmer of 16 bits, a shutter whose Highlight is open, a wheel at its default, ultraviolet, a pixel's dimmer."""
    channels = "".join(channel(f"ColorAdd_{letter}", f"{at}", "Pixel", dmx_break="Overwrite") for at, letter in enumerate("RGB", 1))
    channels += channel("Dimmer", "4", "Pixel", dmx_break="Overwrite") + channel("Dimmer", "11,12")
    channels += channel("Shutter1", "13", values='Highlight="40/1"', default="9/1") + channel("Color1", "14", default="7/1")
    channels += channel("ColorAdd_UV", "15", default="255/1") + channel("Pan", "16,17", default="128/1")
    bar = gdtf("Two pixels", channels, geometries="""<Geometry Name="Body"><GeometryReference Name="Left" Geometry="Pixel">
<Break DMXOffset="1" DMXBreak="1"/></GeometryReference><GeometryReference Name="Right" Geometry="Pixel"><Break DMXOffset="5" DMXBreak="1"/>
</GeometryReference></Geometry><Geometry Name="Pixel"/>""")
    rig, _ = made(relit, tmp_path, mvr(fixture("Bar", "Bar", "Two pixels", "0,0,2000", 101), Bar=bar))
    shared = {111: 255, 112: 255, 113: 40, 114: 7, 115: 0, 116: 128, 117: 128}
    for lamp, own in zip(rig.lights, (104, 108), strict=True):
        assert lamp.address is not None and {held.channel: held.value for held in lamp.address.fixed} == {**shared, own: 255}
    assert not list(patch_faults(rig))


def test_fixtures_of_one_name_are_told_apart_and_hazers_left_out(relit, tmp_path):
    hazer = gdtf("Basic", channel("Fog1", "1"))
    children = [fixture("P", "Wäsche", "RGB 8 bit", "0,0,4000", 1, identity="7"),
                fixture("P", "Wäsche", "RGB 8 bit", "0,9,4000", None, identity="8"), fixture("H", "Hazer", "Basic", "0,0,1000", 20)]
    rig, printed = made(relit, tmp_path, mvr("".join(children), Wäsche=RGB, Hazer=hazer))
    assert [lamp.name for lamp in rig.lights] == ["P 7", "P 8"] and rig.lights[1].address is None
    assert "lamp P 8: has no address" in printed and "Hazer.gdtf: has no emitters" in printed


@pytest.mark.parametrize("content, named", [
    (b"no zip", "not a zip archive"),
    (zipped({"other.xml": "<a/>"}), "no GeneralSceneDescription.xml"),
    (zipped({"GeneralSceneDescription.xml": "<a"}), "GeneralSceneDescription.xml is damaged"),
    (mvr(""), "has no fixtures"),
    (mvr(fixture("A", "", "M", "0,0,4000", 1)), "fixture A: has no GDTF file"),
    (mvr(fixture("A", "Lost", "M", "0,0,4000", 1)), "Lost.gdtf is not in the scene"),
    (mvr(fixture("A", "Par", "RGB 32 bit", "0,0,4000", 1), Par=RGB), "must be a DMX mode of the file, RGB 8 bit"),
    (mvr(fixture("A", "Par", "M", "0,0,4000", 1), Par=b"no zip"), "Par.gdtf: is no GDTF file"),
    (mvr(fixture("A", "Par", "M", "0,0,4000", 1), Par=zipped({"description.xml": "<a"})), "Par.gdtf: its description.xml is damaged"),
    (mvr(fixture("A", "Par", "RGB 8 bit", "0,0,up", 1), Par=RGB), "is damaged"),
    (mvr(fixture("A", "Par", "RGB 8 bit", "0,0,0", 1), Par=RGB), "stands at the subject"),
    (mvr(fixture("A", "Par", "RGB 8 bit", "0,0,4000", 511), Par=RGB), "universes 1, 2"),
    (mvr(fixture("H", "Hazer", "Basic", "0,0,4000", 1), Hazer=gdtf("Basic", channel("Fog1", "1"))), "no fixtures with emitters"),
])
def test_a_wrong_scene_is_one_sentence(relit, tmp_path, content, named):
    (tmp_path / "scene.mvr").write_bytes(content)
    relit("rig", "from-mvr", tmp_path / "scene.mvr", "--out", tmp_path / "rig.json").refused(named)
    assert not (tmp_path / "rig.json").exists()


@pytest.mark.parametrize("package", ["pymvr", "pygdtf"])
def test_a_missing_package_is_one_sentence(relit, tmp_path, monkeypatch, package):
    for module in ("service.rigs.mvr", "service.rigs.gdtf"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / "scene.mvr").write_bytes(mvr(""))
    outcome = relit("rig", "from-mvr", tmp_path / "scene.mvr", "--out", tmp_path / "rig.json")
    assert outcome.code == 2 and package in outcome.err and "pip install 'relit[set]'" in outcome.err and outcome.err.count("\n") == 1
