"""Binary glTF read for tests, and judged by the validator of Khronos."""

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from pygltflib import GLTF2

COMPONENTS = {5121: "<u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
SIZES = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
PACKAGES = Path(os.environ.get("RELIT_TEST_NODE_MODULES", Path(__file__).parents[4] / ".clients" / "node_modules"))
PROGRAM = """
const validator = require(process.argv[1]), fs = require('fs');
(async () => {
  const reports = [];
  for (const file of process.argv.slice(2)) reports.push(await validator.validateBytes(new Uint8Array(fs.readFileSync(file))));
  console.log(JSON.stringify(reports));
})();
"""


class Read:
    """A .glb file and what it holds."""

    def __init__(self, path: Path) -> None:
        self.document = GLTF2.load(str(path))
        self.data = self.document.binary_blob()
        self.primitive = self.document.meshes[0].primitives[0]
        self.material = self.document.materials[0]

    def array(self, accessor: int) -> np.ndarray:
        """Return the values of an accessor, [n] or [n, components]."""
        found = self.document.accessors[accessor]
        view = self.document.bufferViews[found.bufferView]
        start = (view.byteOffset or 0) + (found.byteOffset or 0)
        values = np.frombuffer(self.data, COMPONENTS[found.componentType], found.count * SIZES[found.type], start)
        return values.reshape(found.count, -1).squeeze() if found.type != "SCALAR" else values

    def attribute(self, name: str) -> np.ndarray:
        return self.array(getattr(self.primitive.attributes, name))

    def triangles(self) -> np.ndarray:
        return self.array(self.primitive.indices).reshape(-1, 3)

    def image(self, texture: int, tmp_path: Path) -> tuple[np.ndarray, int]:
        """Return the codes of a texture's image as fractions [rows, cols, 3], and its bits a channel."""
        image = self.document.images[self.document.textures[texture].source]
        view = self.document.bufferViews[image.bufferView]
        assert image.mimeType == "image/png"
        file = tmp_path / "taken_out.png"
        file.write_bytes(self.data[view.byteOffset:view.byteOffset + view.byteLength])
        bits = file.read_bytes()[24]
        codes = oiio.ImageBuf(str(file)).get_pixels(oiio.UINT16 if bits == 16 else oiio.UINT8)
        return codes.astype(np.float64) / (2**bits - 1), bits

    def world_from_node(self, number: int) -> np.ndarray:
        """Return the transform of a child of the root node, [4, 4]."""
        root = self.document.nodes[self.document.scenes[self.document.scene].nodes[0]]
        assert number in root.children
        matrix = np.eye(4) if root.matrix is None else np.array(root.matrix).reshape(4, 4).T
        own = np.eye(4)
        own[:3, 3] = self.document.nodes[number].translation or 0
        return matrix @ own


def validate(*files: Path) -> list[dict[str, Any]]:
    """Return the validator's report on each file, or skip the test where Node or the validator is missing."""
    node, package = shutil.which("node"), PACKAGES / "gltf-validator"
    if node is None or not package.exists():
        missing = f"the glTF validator is missing: no node, or no {package}; RELIT_TEST_NODE_MODULES names another folder"
        if os.environ.get("RELIT_TEST_CLIENTS") == "required":
            pytest.fail(missing)
        pytest.skip(missing)
    done = subprocess.run([node, "-e", PROGRAM, str(package), *map(str, files)], capture_output=True, text=True, timeout=60, check=True)
    return json.loads(done.stdout)


def findings(report: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the errors, warnings and hints of a report; what is only information (severity 2, such as sizes of images) is left out."""
    return [(message["code"], message["message"]) for message in report["issues"]["messages"] if message["severity"] != 2]
