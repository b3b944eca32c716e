"""The extension in Blender, driven by a script; and its picture for docs/blender.md, with the error of each light.

    python -m benchmarks.clients.panel --picture docs/blender.png

solves the shipped owl by the operators of the panel, renders it under captured lights, and prints the RMSE of each render over the mean of
its photograph: all pixels of the mask, no factor of brightness. It does the same with relit frames under the owl's environment as the world
of the scene, and Blender's render under it.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from benchmarks.accuracy import SAMPLES
from benchmarks.clients import installed
from benchmarks.clients.comparison import compare
from benchmarks.clients.render import TIME_LIMIT_S
from service.blender.package import pack
from service.requests.export import BlenderExtensionRequest
from stage.capture.capture import Capture
from stage.formats import exr
from stage.stack.correction import Correction

ROOT = Path(__file__).parents[2]
START = """
import bpy, json, sys
given = json.loads(sys.argv[1])
bpy.ops.wm.read_factory_settings()
bpy.ops.extensions.package_install_files(filepath=given["zip"], repo="user_default", enable_on_install=True)
NAME = "bl_ext.user_default.relit"
preferences = bpy.context.preferences.addons[NAME].preferences
preferences.program = given["program"]
found = {}

def refused(operator, **options):
    '''The sentence with which an operator refuses.'''
    try:
        operator(**options)
    except RuntimeError as error:
        return str(error).removeprefix("Error: ").strip()

def settings(**values):
    for name, value in values.items():
        setattr(bpy.context.scene.relit, name, value)
    return bpy.context.scene.relit

def render(path, samples, bounces=8):
    scene = bpy.context.scene
    scene.cycles.device, scene.cycles.samples, scene.cycles.seed = "CPU", samples, 1
    scene.cycles.use_denoising = scene.cycles.use_adaptive_sampling = False
    scene.cycles.max_bounces = bounces
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
"""
END = """
print("FOUND" + json.dumps(found))
"""
PICTURE = """
from mathutils import Vector
settings(capture=given["capture"], levels=0, sky=given["capture"] + "/environment.exr")
bpy.ops.relit.solve()
scene = bpy.context.scene
for index in given["lights"]:
    settings(light_index=index)
    render(f"{given['folder']}/{index}.exr", 64)
settings(light="SCENE")
x, y, z = given["between"]
for kind, energy, axis in (("SUN", 3, (x, -z, y)), ("SUN", 0.4, (-0.7, -0.6, 0.2))):
    data = bpy.data.lights.new(kind, kind)
    data.energy, data.angle = energy, 0.05
    data.color = (1, 0.75, 0.5) if energy > 1 else (0.4, 0.6, 1)
    lamp = bpy.data.objects.new(kind, data)
    scene.collection.objects.link(lamp)
    lamp.rotation_mode, lamp.rotation_quaternion = "QUATERNION", Vector(axis).to_track_quat("Z", "Y")
scene.frame_start = scene.frame_end = 1
render(f"{given['folder']}/between.exr", 64)
bpy.ops.relit.relight()

settings(light="ENVIRONMENT")
scene.frame_start = scene.frame_end = 2
for each in [each for each in scene.objects if "relit_card" in each]:
    bpy.data.objects.remove(each)
render(f"{given['folder']}/world.exr", 64)
bpy.ops.relit.relight()
scene.frame_start = scene.frame_end = 3
settings(guided=False)
bpy.ops.relit.relight()
"""
SHOWN = 31
"""The captured light of the picture, 20 degrees from the view axis."""


def in_blender(script: str, folder: Path, **values: object) -> dict:
    """Return what a script found in Blender, where the extension is installed from its zip as a user installs it.

    Args:
        script: has `given`, the values and `folder`; it fills `found`.
        folder: for the zip, the program and the settings of Blender.

    Raises:
        MissingClientError: Blender is not installed.
        RuntimeError: the script fails; the text ends with what it said.
    """
    program = folder / "relit"
    program.write_text(f"#!{sys.executable}\nfrom service.cli.main import main\nmain()\n")
    program.chmod(0o755)
    packed = pack(BlenderExtensionRequest(out=folder / "relit.zip"))
    given = {"zip": str(packed), "program": str(program), "folder": str(folder), **values}
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(folder / "user"), "PYTHONPATH": str(ROOT)}
    python = installed.python_with("bpy", "RELIT_TEST_BLENDER_PYTHON")
    done = subprocess.run([python, "-P", "-c", START + script + END, json.dumps(given, default=str)], capture_output=True, text=True,
                          timeout=TIME_LIMIT_S, env=environment)
    if done.returncode:
        raise RuntimeError((done.stdout + done.stderr)[-4000:])
    return json.loads(re.search("FOUND(.*)", done.stdout)[1])


def picture(path: Path) -> np.ndarray:
    """Return R, G, B and A of a file, [rows, cols, 4] float64."""
    channels, _ = exr.read(path)
    return np.stack([channels[name] for name in "RGBA"], axis=-1).astype(np.float64)


def main() -> None:
    """Print the errors, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--picture", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        owl = shutil.copytree(SAMPLES / "owl", folder / "owl", ignore=shutil.ignore_patterns(".relit"))
        capture = Capture.open(owl)
        lights = [np.array(frame["light"]["direction"]) for frame in json.loads((owl / "capture.json").read_text())["frames"]]
        order = sorted((index for index in range(len(lights)) if lights[index][2] > 0), key=lambda index: -lights[index][2])
        chosen = sorted({*order[:: len(order) // 8][:8], SHOWN}, key=order.index)
        between = (lights[order[0]] + lights[SHOWN] + lights[order[8]]) / 3
        in_blender(PICTURE, folder, capture=owl, lights=chosen, between=between.tolist())
        correction, sources, mask = Correction.of(capture), list(capture.sources()), capture.mask()
        for index in chosen:
            photograph = correction.apply(sources[index]).pixels
            error = compare(picture(folder / f"{index}.exr")[..., :3], photograph, mask, scaled=False).rmse
            print(f"light {index:2d}, {np.degrees(np.arccos(lights[index][2])):2.0f} degrees from the view axis: {error:.3f}")
            if index == SHOWN:
                shown = [photograph, picture(folder / f"{index}.exr")[..., :3]]
        frames, world = folder / "owl_relit" / "relit_frames", picture(folder / "world.exr")[..., :3]
        for number, words in ((2, "photographs and maps"), (3, "photographs alone")):
            error = compare(picture(frames / f"frame.{number:04d}.exr")[..., :3], world, mask, scaled=False).rmse
            print(f"relit under the world, {words}, from Blender's render: {error:.3f}")
        shown += [picture(path)[..., :3] for path in (frames / "frame.0001.exr", folder / "between.exr")]
        if given.picture is not None:
            sheet = np.hstack([np.clip(each, 0, None)[20:-20, 60:-60] for each in shown]) * 1.6
            encoded = np.where(sheet <= 0.0031308, 12.92 * sheet, 1.055 * np.maximum(sheet, 1e-9) ** (1 / 2.4) - 0.055)
            cv2.imwrite(str(given.picture), (255 * np.clip(encoded, 0, 1) + 0.5).astype(np.uint8)[..., ::-1])


if __name__ == "__main__":
    main()
