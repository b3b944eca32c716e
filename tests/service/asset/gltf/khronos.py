"""The glTF validator of Khronos, which runs in Node."""

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

PACKAGES = Path(os.environ.get("RELIT_TEST_NODE_MODULES", Path(__file__).parents[4] / ".clients" / "node_modules"))
PROGRAM = """
const validator = require(process.argv[1]), fs = require('fs');
(async () => {
  const reports = [];
  for (const file of process.argv.slice(2)) reports.push(await validator.validateBytes(new Uint8Array(fs.readFileSync(file))));
  console.log(JSON.stringify(reports));
})();
"""


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
