"""The extension in Blender: installed from its zip as a user installs it, into a folder of the test, and driven by a script."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

from benchmarks.clients import installed
from benchmarks.clients.render import TIME_LIMIT_S, Client
from service.blender.package import pack
from service.requests.export import BlenderExtensionRequest
from tests.clients.programs import require

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


def in_blender(script: str, folder: Path, **values: object) -> dict:
    """Return what a script found: the extension is installed, and `given` holds the values and the folder `folder`."""
    require(Client.BLENDER)
    program = folder / "relit"
    program.write_text(f"#!{sys.executable}\nfrom service.cli.main import main\nmain()\n")
    program.chmod(0o755)
    packed = pack(BlenderExtensionRequest(out=folder / "relit.zip"))
    given = {"zip": str(packed), "program": str(program), "folder": str(folder), **values}
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(folder / "user"), "PYTHONPATH": str(ROOT)}
    python = installed.python_with("bpy", "RELIT_TEST_BLENDER_PYTHON")
    done = subprocess.run([python, "-P", "-c", START + script + END, json.dumps(given, default=str)], capture_output=True, text=True,
                          timeout=TIME_LIMIT_S, env=environment)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return json.loads(re.search("FOUND(.*)", done.stdout)[1])
