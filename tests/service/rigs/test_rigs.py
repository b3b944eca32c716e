"""relit rig: check, from-capture, from-csv and plan."""

import csv
import json

import numpy as np
import pytest

from stage.rig.rig import read_rig
from stage.transforms import fibonacci_sphere
from tests.scenes.rigs import write_rig, write_sky
from tests.service.owl import write_small_owl


def test_a_rig_is_made_of_a_capture(relit, tmp_path):
    """Directions and irradiances are those of the manifest; each lamp has channels of its own."""
    capture = write_small_owl(tmp_path / "owl", 4)
    outcome = relit("rig", "from-capture", capture, "--out", tmp_path / "rig.json", "--universe", "5")
    assert outcome.code == 0, outcome.err
    rig = read_rig(tmp_path / "rig.json")
    lit = [frame for frame in json.loads((capture / "capture.json").read_text())["frames"] if frame["light"]["type"] == "distant"]
    assert rig.directions == pytest.approx(np.array([frame["light"]["direction"] for frame in lit]), abs=1e-6)
    assert [sum(p.irradiance[c] for p in lamp.primaries) for lamp in rig.lights for c in range(3)] == pytest.approx(
        [value for frame in lit for value in frame["light"]["irradiance"]])
    outcome = relit("rig", "check", tmp_path / "rig.json", "--picture", tmp_path / "dome.png")
    assert outcome.code == 0, outcome.err
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
    outcome = relit("rig", "from-csv", tmp_path / "dome.csv", "--out", tmp_path / "rig.json", "--primaries", "white", "--bits", "16",
                    "--protocol", "artnet", "--irradiance", "0.5")
    assert outcome.code == 0, outcome.err
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
])
def test_a_wrong_table_is_one_sentence(relit, tmp_path, text, named):
    (tmp_path / "dome.csv").write_text(text)
    outcome = relit("rig", "from-csv", tmp_path / "dome.csv", "--out", tmp_path / "rig.json")
    assert outcome.code == 2 and named in outcome.err and outcome.err.count("\n") == 1
    assert not (tmp_path / "rig.json").exists()


def test_more_lamps_plan_a_smaller_error(relit, tmp_path):
    write_sky(tmp_path / "sky.exr", "sun", rows=32)
    write_rig(tmp_path / "rig.json", fibonacci_sphere(64), name='the "new" dome')
    outcome = relit("rig", "plan", "--environment", tmp_path / "sky.exr", "--lights", "16,64,256", "--rig", tmp_path / "rig.json",
                    "--out", tmp_path / "plan")
    assert outcome.code == 0, outcome.err
    with open(tmp_path / "plan" / "plan.csv", newline="") as file:
        *rows, given = csv.DictReader(file)
    assert given == {**rows[1], "rig": 'the "new" dome'}  # the same directions
    for column in ("irradiance_percent", "highlights_0.6_percent"):
        errors = [float(row[column]) for row in rows]
        assert errors == sorted(errors, reverse=True) and errors[-1] < 0.5 * errors[0]
    assert (tmp_path / "plan" / "plan.png").stat().st_size > 1000
