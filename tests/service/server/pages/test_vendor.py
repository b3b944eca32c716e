"""The vendored three.js is what its package holds, whole, and in the import map of the pages."""

import hashlib
import json
import posixpath
import re
from pathlib import Path

from service.server.pages.routes import IMPORT_MAP, STATIC

PAGES = Path(__file__).resolve().parents[4] / "service/server/pages"
VENDORED = PAGES / "static/vendor/three"
PACKAGE = Path(__file__).resolve().parents[3] / "clients/package.json"
IMPORT = re.compile(r"^(?:import|export)\b[^;'\"]*?from\s*['\"]([^'\"]+)['\"]", re.MULTILINE)


def recorded() -> dict[str, str]:
    """The hash of each file, as `make vendor` wrote it."""
    lines = (VENDORED / "SHA256SUMS").read_text().splitlines()
    return {path: digest for digest, path in (line.split("  ") for line in lines)}


def test_files_are_those_of_the_package_in_the_version_that_assets_are_tested_with():
    found = {path.relative_to(VENDORED).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
             for path in VENDORED.rglob("*") if path.is_file() and path.name != "SHA256SUMS"}
    assert found == recorded()
    assert "LICENSE" in found
    revision = re.search(r"REVISION = '(\d+)'", (VENDORED / "three.core.js").read_text())
    assert revision is not None
    assert json.loads(PACKAGE.read_text())["dependencies"]["three"].split(".")[1] == revision[1]


def test_all_that_they_import_is_vendored_and_in_the_import_map():
    imports = {path: IMPORT.findall((VENDORED / path).read_text()) for path in recorded() if path.endswith(".js")}
    assert "./three.core.js" in imports["three.module.js"]
    for path, names in imports.items():
        for name in names:
            file = posixpath.normpath(posixpath.join(posixpath.dirname(path), name))
            assert name == "three" or file in recorded(), f"{path} imports {name}"
    for name, address in json.loads(IMPORT_MAP)["imports"].items():
        path = VENDORED.parents[1] / address.removeprefix(f"{STATIC}/")
        assert path.is_dir() if name.endswith("/") else path.is_file(), name
