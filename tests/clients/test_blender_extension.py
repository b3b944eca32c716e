"""The extension for Blender: packed, checked by Blender, installed, drawn, refusing, working by program and by service, and removed."""

import ast
import subprocess
import sys
import tomllib
import zipfile

import numpy as np
import pytest

from benchmarks.clients import installed
from benchmarks.clients.render import Client
from service import __version__
from service.blender.package import SOURCES, pack
from service.errors import RequestError
from service.requests.export import BlenderExtensionRequest
from stage.formats import exr
from stage.results.maps import MAPS_FILE, SurfaceMaps
from tests.clients.blender import in_blender
from tests.clients.programs import require
from tests.scenes.captures import make_scene, write_capture
from tests.service.server_process import serving


def test_the_zip_is_the_same_twice_and_has_the_version_of_the_program(tmp_path):
    one, other = (pack(BlenderExtensionRequest(out=tmp_path / f"{name}.zip")) for name in "ab")
    assert one.read_bytes() == other.read_bytes()
    with zipfile.ZipFile(one) as packed:
        manifest = tomllib.loads(packed.read("blender_manifest.toml").decode())
        assert "__init__.py" in packed.namelist()
    assert manifest["version"] == __version__.partition("+")[0].partition(".dev")[0] and manifest["id"] == "relit"
    assert manifest["blender_version_min"] == "4.2.0" and manifest["permissions"].keys() == {"network", "files"}
    with pytest.raises(RequestError, match=r"end with \.zip"):
        pack(BlenderExtensionRequest(out=tmp_path / "relit.tar"))
    assert {path.name for path in tmp_path.iterdir()} == {"a.zip", "b.zip"}


def test_its_modules_import_themselves_blender_and_the_standard_library_alone():
    for path in SOURCES.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.level == 0 else []
            assert {name.partition(".")[0] for name in names} <= sys.stdlib_module_names | {"bpy", "bpy_extras", "mathutils"}, path.name


@pytest.mark.long
def test_blender_finds_the_manifest_valid(tmp_path):
    require(Client.BLENDER)
    packed = pack(BlenderExtensionRequest(out=tmp_path / "relit.zip"))
    python = installed.python_with("bpy", "RELIT_TEST_BLENDER_PYTHON")
    check = next(python.parents[1].glob("lib/python*/site-packages/bpy/*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))
    done = subprocess.run([python, check, "validate", packed], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and "Success" in done.stdout, done.stdout + done.stderr


REFUSALS = """
from types import SimpleNamespace
import importlib
extension = importlib.import_module(NAME)
from pathlib import Path

class Layout:
    '''Takes what a panel draws.'''
    def __init__(self): self.drawn = []
    def box(self): return self
    def label(self, text="", **more): self.drawn.append(text)
    def prop(self, given, name, **more):
        assert name in given.bl_rna.properties, name
        self.drawn.append(name)
    def operator(self, name, **more):
        getattr(bpy.ops.relit, name.partition(".")[2]).get_rna_type()
        self.drawn.append(name)
    def progress(self, factor=0.0, text=""): self.drawn.append(text)

def drawn():
    layout = Layout()
    bpy.types.RELIT_PT_capture.draw(SimpleNamespace(layout=layout), bpy.context)
    return layout.drawn

found["drawn"] = drawn()
folder = Path(given["folder"])
found["no capture"] = [refused(bpy.ops.relit.solve)]
settings(capture=str(folder))
found["no capture"].append(refused(bpy.ops.relit.solve))
settings(capture=given["capture"])
found["no asset"] = [refused(bpy.ops.relit.import_asset), refused(bpy.ops.relit.relight)]
found["no asset"].append(refused(bpy.ops.relit.show_frames, filepath="/none"))
(folder / "broken").mkdir()
(folder / "broken" / "capture.json").write_text("{")
settings(capture=str(folder / "broken"))
found["broken"] = refused(bpy.ops.relit.solve)
settings(capture=given["unlit"])
found["unlit"] = refused(bpy.ops.relit.solve)
settings(capture=given["capture"])
preferences.program = str(folder / "gone")
found["no program"] = [refused(bpy.ops.relit.solve), " ".join(drawn())]
preferences.program = "/bin/sh"
found["another program"] = refused(bpy.ops.relit.solve)
preferences.backend, preferences.url = "SERVICE", "http://127.0.0.1:1"
found["no service"] = refused(bpy.ops.relit.solve)
found["still drawn"] = " ".join(drawn())
preferences.url = "http://["
found["no address"] = [refused(bpy.ops.relit.solve), " ".join(drawn())]
preferences.url = "http://relit.invalid"
found["offline"] = refused(bpy.ops.relit.solve)
found["old"] = None
try:
    extension.check_version((4, 1, 1))
except RuntimeError as error:
    found["old"] = str(error)

# a service that has lost an environment, whose stream of events is cut in a line, that hangs up once, and then is gone for good
import http.server, json, threading
service, tasks = (importlib.import_module(f"{NAME}.{name}") for name in ("service", "tasks"))
asked, hang_ups = [], [1]

class Cut(http.server.BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    def log_message(self, *given): pass
    def do_GET(self):
        asked.append(self.path)
        if self.path.endswith("/events"):
            self.send_response(200)
            self.send_header("Transfer-Encoding", "chunked")
            self.end_headers()
            piece = b'data: {"state": "runn'
            self.wfile.write(f"{len(piece):x}\\r\\n".encode() + piece + b"\\r\\n0\\r\\n\\r\\n")
            return
        if self.path.endswith("/results"):
            return self.say({"results": [{"name": "picture.exr", "url": "/file", "size": 4}], "next": None})
        if self.path == "/file":
            return self.say("four")
        if self.path == "/v1/environments/j":
            return self.say({"id": "j", "state": "ready"})
        if hang_ups[0]:
            hang_ups[0] -= 1
            self.close_connection = True
            return
        self.say({"state": "succeeded", "progress": None, "error": None})
    def do_POST(self):
        asked.append(self.path)
        self.rfile.read(int(self.headers.get("Content-Length", 0)))
        again = asked.count(self.path) > 1  # an environment of this token was deleted
        self.say({"id": "j", "state": "ready"}, 200 if again or not self.path.endswith("environments") else 404)
    def say(self, what, code=200):
        body = what.encode() if isinstance(what, str) else json.dumps(what).encode()
        self.send_response(code)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Cut)
threading.Thread(target=server.serve_forever, daemon=True).start()
url = f"http://127.0.0.1:{server.server_port}"
(folder / "served").mkdir()
(folder / "served" / service.JOB_FILE).write_text(json.dumps({"service": url, "job": "maps"}))
def shade(name):
    task = tasks.Task("Shading")
    task.run(lambda task: service.Service(url, "").shade(
        folder / "served", {}, folder / "relit.zip", folder / "pictures" / name, task))
    return task.error
error = shade("one.exr")
found["cut"] = [(folder / "pictures" / "one.exr").read_bytes().hex() if error is None else error, error]
service.PATIENCE_S, hang_ups[0] = 0, 99
error = shade("two.exr")
found["given up"] = ["is not reached" if "is not reached" in (error or "") else error, asked[-1].rpartition("/")[2]]
found["given up"] += [] if not (folder / "pictures" / "two.exr").exists() else ["two.exr"]
server.shutdown()

# begun and not waited for: Blender goes on, and the timer's function is called by hand, since there is no loop of events
import time
preferences.backend, preferences.program = "PROGRAM", given["program"]
bpy.ops.relit.solve(wait=False)
found["busy"] = [refused(bpy.ops.relit.solve), refused(bpy.ops.relit.relight)]
found["shown"] = drawn()
bpy.ops.relit.cancel()
deadline = time.monotonic() + 50
while tasks.poll() is not None and time.monotonic() < deadline:
    time.sleep(0.01)
found["cancelled"] = tasks.current.error
found["poll"] = bpy.ops.relit.cancel.poll()
found["registered"] = bpy.app.timers.is_registered(tasks.poll)

bpy.ops.relit.solve(wait=False)  # under way when the extension is disabled
bpy.ops.preferences.addon_disable(module=NAME)
found["left"] = [name for name in dir(bpy.types) if "relit" in name.lower()] + [name for name in dir(bpy.types.Scene) if "relit" in name]
found["left"] += ["timer"] * bpy.app.timers.is_registered(tasks.poll)
bpy.ops.preferences.addon_enable(module=NAME)
found["again"] = hasattr(bpy.types, "RELIT_PT_capture")
"""


@pytest.mark.long
def test_it_draws_refuses_cancels_and_leaves_nothing_behind(tmp_path):
    capture = write_capture(tmp_path / "cap", make_scene(size=48, lights=24))
    unlit = write_capture(tmp_path / "unlit", make_scene(size=8, lights=3), color_space="none")
    found = in_blender(REFUSALS, tmp_path, capture=capture, unlit=unlit)
    assert found["drawn"] == ["Capture", "capture", "out", "sky", "levels", "relit.solve",
                              "Asset", "asset", "mesh", "look", "relit.import_asset"]
    assert found["no capture"] == ["no capture is chosen: give a folder with a capture.json",
                                   f"{tmp_path} is no capture: it has no capture.json"]
    assert "asset.usda is not there" in found["no asset"][0]
    assert "no asset is imported" in found["no asset"][1] and "no asset is imported" in found["no asset"][2]
    assert "broken/capture.json cannot be read" in found["broken"]
    assert found["unlit"].startswith("relit solve: ") and "color_space" in found["unlit"]  # the sentence of the program
    assert all("gone" in sentence and "preferences" in sentence for sentence in found["no program"])
    assert found["another program"].startswith("relit solve: ")
    assert "http://127.0.0.1:1 is not reached" in found["no service"]
    assert "relit.solve" in found["still drawn"] and "is not reached" in found["still drawn"]
    assert all("'http://[' is no address" in sentence for sentence in found["no address"])
    assert "offline" in found["offline"]
    assert found["cut"] == [b"four".hex(), None] and found["given up"] == ["is not reached", "cancel"]
    assert found["old"].startswith("Relit needs Blender 4.2 or later, and this is 4.1.1")
    assert found["busy"] == 2 * ["Solving is under way: wait for it, or cancel it"]
    assert "relit.cancel" in found["shown"]
    assert found["cancelled"] == "Solving is cancelled" and not found["poll"] and found["registered"]
    assert found["left"] == [] and found["again"]
    assert not (tmp_path / "cap_relit" / "maps" / MAPS_FILE).exists()


SERVED = """
from pathlib import Path
preferences.backend, preferences.url = "SERVICE", given["url"]
folder = Path(given["folder"])
settings(capture=given["capture"], out=str(folder / "out"), levels=0)
import importlib, time
tasks = importlib.import_module(NAME + ".tasks")
bpy.ops.relit.solve(wait=False)
deadline = time.monotonic() + 50
while tasks.current.stage in ("", "reading cap", "sending cap", "checking cap"):  # until the job is under way
    assert not tasks.current.ended and time.monotonic() < deadline, (tasks.current.stage, tasks.current.error)
    time.sleep(0.01)
bpy.ops.relit.cancel()
while tasks.poll() is not None and time.monotonic() < deadline:
    time.sleep(0.01)
found["cancelled"] = tasks.current.error
bpy.ops.relit.solve()
scene = bpy.context.scene
scene.frame_start = scene.frame_end = 7
found["light"] = scene.relit.light_index
bpy.ops.relit.relight()
settings(method="SHADE")
bpy.ops.relit.relight()
found["cards"] = sorted(each["relit_card"] for each in bpy.data.objects if "relit_card" in each)
settings(out=str(folder / "other"), method="RELIGHT")
(folder / "other" / "maps").mkdir(parents=True)
found["other maps"] = [refused(bpy.ops.relit.relight)]
settings(out=str(folder / "out"))
preferences.backend, preferences.program = "PROGRAM", "/bin/sh"
refused(bpy.ops.relit.solve)  # after which the maps may be others than those of the service's job
preferences.backend = "SERVICE"
found["other maps"].append(refused(bpy.ops.relit.relight))
"""


@pytest.mark.long
def test_a_service_solves_and_relights_as_the_program_does(tmp_path):
    scene = make_scene(size=32, lights=12)
    capture = write_capture(tmp_path / "cap", scene)
    with serving(tmp_path / "server", "--anonymous", "--device", "cpu") as server:
        found = in_blender(SERVED, tmp_path, capture=capture, url=server.url)
    assert found["cancelled"] == "Solving is cancelled"
    maps = SurfaceMaps.read(tmp_path / "out" / "maps" / MAPS_FILE)
    assert maps.mask.sum() > 0.9 * scene.mask.sum()
    frame, _ = exr.read(tmp_path / "out" / "relit_frames" / "frame.0007.exr")
    picture = np.stack([frame[name] for name in "RGB"], axis=-1)
    np.testing.assert_allclose(picture[scene.mask], scene.images[found["light"]][scene.mask], rtol=2e-3, atol=1e-4)  # half
    assert found["cards"] == [str(tmp_path / "out" / f"{name}_frames" / "frame.0007.exr") for name in ("relit", "shaded")]
    assert all("this service has not solved these maps" in sentence for sentence in found["other maps"])
