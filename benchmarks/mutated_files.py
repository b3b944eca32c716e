"""The files that benchmarks.file_mutations damages: a small sound one of each kind, and the reader that a stranger's file comes to."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import OpenEXR
import OpenImageIO as oiio

from service.captures.admit import admit_capture, admit_environment
from service.captures.info import inspect
from service.requests.captures import InfoRequest
from service.requests.light.light_keys import LightKeys
from service.server.base.settings import Settings
from stage.capture.capture import Capture
from stage.capture.manifest import read_manifest
from stage.colour.environment_maps import check_environment, read_environment
from stage.colour.radiance import check_radiance
from stage.formats import exr, images
from stage.importers import lp
from stage.importers.opencv_file import read_matrices
from stage.results.maps import SurfaceMaps
from stage.stack.ingest import open_stack
from stage.tof.calibration import read_calibration, read_sweep
from stage.tof.raw_frames import read_array
from stage.tof.scan import read_scan
from tests.scenes.captures import edit_manifest, make_scene, write_capture, write_image
from tests.stage.results.test_maps import make_maps

MAX_PIXELS = 4096
"""The setting of the checks; larger claims are refused."""
SAMPLES = Path(__file__).parents[1] / "samples"
SIDE = 16


class Kind(NamedTuple):
    """A kind of file."""

    name: str
    path: Path
    """The sound file, below the folder that `kinds` was called with."""
    read: Callable[[Path], object]
    """Reads the damaged file at its place in a copy of that folder; the argument is its path."""
    text: bool = False


def read_image(path: Path) -> None:
    """Read an image as a check and then as ingest do."""
    header = images.read_header(path)
    if header.width * header.height <= MAX_PIXELS and header.stored <= 64:
        check_radiance(path, images.read_pixels(path).astype(np.float32))


def _avif(path: Path, codes: np.ndarray) -> Path:
    """Write 8-bit codes as AVIF."""
    cv2.imwrite(str(path), codes)
    return path


def read_exr(path: Path) -> None:
    """Read an EXR as an image, and its channels as maps are read."""
    header = exr.read_header(path)
    if header.width * header.height <= MAX_PIXELS:
        exr.read(path)
    read_image(path)


def read_capture(path: Path) -> None:
    """Read a capture as a check, a job and `relit info` do."""
    folder = path.parent
    admit_capture(folder, max_pixels=MAX_PIXELS)
    capture = Capture.open(folder)
    if capture.sources():
        open_stack(capture)
        shutil.rmtree(folder / ".relit")
    capture.mask_values()
    inspect(InfoRequest(capture=folder))


def read_sky(path: Path) -> None:
    """Read an environment as a check and a relight do."""
    admit_environment(path, max_pixels=MAX_PIXELS)
    check_environment(path)
    read_environment(path, "lin_rec709_scene")


def read_lp(path: Path) -> None:
    """Import an `.lp` file."""
    try:
        lp.import_folder(path, path.parent / "imported")
    finally:
        shutil.rmtree(path.parent / "imported", ignore_errors=True)


def _exr_file(path: Path, compression: object, dtype: type[np.generic], **header: object) -> Path:
    values = np.random.default_rng(0).random((SIDE, SIDE, 3)).astype(dtype)
    OpenEXR.File({"compression": compression, "type": OpenEXR.scanlineimage, **header},
                 {name: np.ascontiguousarray(values[..., channel]) for channel, name in enumerate("RGB")}).write(str(path))
    return path


def _tiled(path: Path) -> Path:
    out = oiio.ImageOutput.create(str(path))
    spec = oiio.ImageSpec(SIDE, SIDE, 3, "half")
    spec.tile_width = spec.tile_height = 8
    assert out.open(str(path), spec)
    assert out.write_image(np.random.default_rng(1).random((SIDE, SIDE, 3)).astype(np.float32))
    out.close()
    return path


def _json(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def kinds(folder: Path) -> list[Kind]:
    """Write one sound file of each kind below a folder, and return them."""
    rng = np.random.default_rng(2)
    folder.mkdir(parents=True)
    noise = rng.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
    alpha = rng.integers(0, 65536, (SIDE, SIDE, 4), dtype=np.uint16)
    made = [
        Kind("EXR, ZIP", _exr_file(folder / "zip.exr", OpenEXR.ZIP_COMPRESSION, np.float16), read_exr),
        Kind("EXR, PIZ", _exr_file(folder / "piz.exr", OpenEXR.PIZ_COMPRESSION, np.float32), read_exr),
        Kind("EXR, DWAA", _exr_file(folder / "dwaa.exr", OpenEXR.DWAA_COMPRESSION, np.float16), read_exr),
        Kind("EXR, B44", _exr_file(folder / "b44.exr", OpenEXR.B44_COMPRESSION, np.float16), read_exr),
        Kind("EXR, RLE", _exr_file(folder / "rle.exr", OpenEXR.RLE_COMPRESSION, np.float16), read_exr),
        Kind("EXR, tiles", _tiled(folder / "tiles.exr"), read_exr),
        Kind("PNG, 8 bits", write_image(folder / "a.png", noise), read_image),
        Kind("PNG, 16 bits and alpha", write_image(folder / "b.png", alpha), read_image),
        Kind("JPEG", write_image(folder / "a.jpg", noise), read_image),
        Kind("TIFF, 8 bits", write_image(folder / "a.tif", noise), read_image),
        Kind("TIFF, float", write_image(folder / "b.tif", noise.astype(np.float32)), read_image),
        Kind("HDR", write_image(folder / "a.hdr", rng.random((SIDE, SIDE, 3)).astype(np.float32)), read_image),
        Kind("DPX", write_image(folder / "a.dpx", noise), read_image),
        Kind("AVIF", _avif(folder / "a.avif", noise), read_image),
        Kind("TGA", write_image(folder / "a.tga", noise), read_image),
        Kind("BMP", write_image(folder / "a.bmp", noise), read_image),
        Kind("JPEG XL", write_image(folder / "a.jxl", noise), read_image),
    ]
    parts = [exr.Part(name, {f"{prefix}{channel}": rng.random((SIDE, SIDE)).astype(np.float16) for channel in "RGB"}, "lin_rec709_scene")
             for name, prefix in (("rgba", ""), ("diffuse", "diffuse."))]
    exr.write_parts(folder / "parts.exr", parts, metadata={"note": "two parts"})
    made.append(Kind("EXR, two parts", folder / "parts.exr", read_exr))
    scene = make_scene(size=8, lights=5)
    for name, file in (("capture.json", "capture.json"), ("frame of a capture", "002.exr"), ("mask of a capture", "mask.png")):
        capture = write_capture(folder / file.replace(".", "-"), scene)
        edit_manifest(capture, saturation=0.9)
        made.append(Kind(name, capture / file, read_capture, file.endswith(".json")))
    sky = write_image(folder / "sky.hdr", rng.random((8, 16, 3)).astype(np.float32))
    made.append(Kind("environment", sky, read_sky))
    np.save(folder / "a.npy", rng.random((8, 8, 6)).astype(np.float32))
    made.append(Kind("npy", folder / "a.npy", read_array))
    (folder / "lp").mkdir()
    write_image(folder / "lp" / "a.png", noise)
    (folder / "lp" / "a.lp").write_text("1\na.png 0.1 0.2 0.9\n")
    made.append(Kind("lp", folder / "lp" / "a.lp", read_lp, True))
    made.append(Kind("light keys", _json(folder / "keys.json", {
        "schema": "relit.keys/1", "frames_per_second": 24, "lights": [{"name": "key", "keys": [
            {"frame": 1, "direction": [0, 0, 1], "irradiance": [1, 1, 1]}, {"frame": 9, "direction": [1, 0, 1], "irradiance": [2, 1, 1]}]}],
        "environment": [{"frame": 1, "turn_degrees": 3.0}], "exposure": [{"frame": 1, "stops": -1}]}), LightKeys.read, True))
    made.append(Kind("time-of-flight calibration", _json(folder / "tof.json", {"schema": "relit.tof/1"}), read_calibration, True))
    made.append(Kind("time-of-flight sweep", _json(folder / "sweep.json", {
        "schema": "relit.tof-sweep/1", "steps": [{"capture": "a", "depth_m": 1.0}, {"capture": "b", "depth_m": 2.0}]}), read_sweep, True))
    (folder / "scan").mkdir()
    np.save(folder / "scan" / "shots.npy", rng.random((20, 5)))
    manifest = _json(folder / "scan" / "scan.json", {"schema": "relit.scan/1", "name": "Yard", "shots": "shots.npy"})
    made += [Kind("scan.json", manifest, read_scan, True),
             Kind("shots of a scan", folder / "scan" / "shots.npy", lambda path: read_scan(path.parent))]
    sample = shutil.copy(SAMPLES / "rig" / "capture.json", folder / "rig.json")
    made.append(Kind("capture.json of the sample rig", sample, read_manifest, True))
    for suffix in (".yml", ".xml", ".json"):
        storage = cv2.FileStorage(str(folder / f"camera{suffix}"), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_matrix", np.eye(3))
        storage.write("distortion", np.zeros(5))
        storage.release()
        made.append(Kind(f"OpenCV {suffix[1:].upper()}", folder / f"camera{suffix}", read_matrices, True))
    make_maps().write(folder / "maps.exr")
    made.append(Kind("maps.exr", folder / "maps.exr", SurfaceMaps.read))
    toml = folder / "relit.toml"
    toml.write_text('port = 8470\nroots = ["/captures"]\nlog_level = "info"\nmax_pixels = 4096\n')
    made.append(Kind("settings", toml, lambda path: Settings(config=path, data=folder / "data"), True))
    for kind in made:
        kind.read(kind.path)  # or its cases would prove nothing
    return made
