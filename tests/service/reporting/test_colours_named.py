"""Every kind of result names the configuration of colours by which it was made, and its cache id."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from pxr import Sdf

from service.reporting.progress import Timings
from service.requests.play import TwinRequest
from service.twin.camera import TwinPicture
from stage.colour.configuration import current
from stage.formats import exr
from stage.rig.rig import read_rig
from tests.scenes.captures import make_scene, write_capture, write_exr
from tests.scenes.patched_rigs import write_rig_file

ATTRIBUTES = ("relit:ocio", "relit:ocio_cache_id")
SIZE = 24


def of_image(path: Path) -> tuple:
    if path.suffix == ".exr":
        _, metadata = exr.read(path)
        return tuple(metadata.get(name) for name in ATTRIBUTES)
    spec = oiio.ImageBuf(str(path)).spec()
    return tuple(spec.getattribute(name) for name in ATTRIBUTES)


def of_layer(path: Path) -> tuple:
    data = Sdf.Layer.FindOrOpen(str(path)).customLayerData
    return data["relit"]["ocio"], data["relit"]["ocio_cache_id"]


def of_text(path: Path) -> tuple:
    """The configuration and the cache id where a file holds both as text, between other bytes."""
    return tuple(value if value.encode() in path.read_bytes() else None for value in (current().label, current().cache_id))


READ = {".exr": of_image, ".png": of_image, ".usda": of_layer, ".usdz": of_layer}


@pytest.mark.long
def test_every_kind_of_result_names_the_configuration_and_its_cache_id(relit, tmp_path):
    scene = make_scene(size=SIZE, lights=5)
    cap = write_capture(tmp_path / "cap", scene)
    rig = write_rig_file(tmp_path / "rig.json", scene.directions, host="127.0.0.1")
    write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3), np.float32))
    write_exr(tmp_path / "card.exr", np.full((SIZE, SIZE, 3), 0.3, np.float32))
    out = tmp_path / "out"
    sky = ("--environment", tmp_path / "sky.exr")
    for command in (
            ("solve", cap, "--method", "lambert", "--out", out),
            *(("export", out, "--out", out / f"asset.{ending}") for ending in ("usda", "usdz", "glb")),
            ("relight", cap, *sky, "--out", out / "frame.#.exr", "--display", out / "shown.#.png", "--sheet", out / "sheet.png",
             "--report", out / "frames.json"),
            ("shade", out, "--light", "0.1,0.2,0.4,0.05,0.05,0.05", "--out", out / "near.exr", "--display", out / "near.png"),
            ("info", cap, "--picture", out / "lights.png"),
            *(("basis", cap, "--out", out / f"basis.{ending}") for ending in ("exr", "rti")),
            ("view", cap, "--out", out / "view"),
            ("drive", rig, *sky, "--auto-exposure", "--out", out / "cues"),
            *(("publish", cap, "--to", out / kind, "--as", kind) for kind in ("web", "openlime")),
            ("publish", cap, "--to", out / "iiif", "--as", "iiif", "--url", "https://museum.org/cap"),
            ("calibrate", "white-balance", cap, tmp_path / "card.exr", "--out", out / "white" / "capture.json")):
        assert relit(*command).code == 0, command
    twin = TwinPicture(read_rig(rig), TwinRequest(rig=rig, capture=cap), Timings(None))
    for name in ("seen.png", "seen.exr"):
        twin.write(out / name, np.ones(3 * len(scene.directions)))
    files = [out / name for name in (
        "maps.exr", "report.json", "asset.usda", "asset.usdz", "asset.glb", "frame.1.exr", "shown.1.png", "sheet.png",
        "frames.json", "near.exr", "near.png", "lights.png", "view/view.json", "cues/report.json", "cues/preview.png",
        "basis.exr", "web/publication.json", "openlime/publication.json", "iiif/manifest.json", "white/calibration.json",
        "seen.png", "seen.exr")]
    named = {str(path.relative_to(out)): READ.get(path.suffix, of_text)(path) for path in files}
    assert named == dict.fromkeys(named, (current().label, current().cache_id))
