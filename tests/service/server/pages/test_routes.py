"""Pages are complete, load nothing from elsewhere, and hold nothing of a project; three.js beside them is what its package holds, whole."""

import hashlib
import json
import posixpath
import re
from collections.abc import Callable, Iterator
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import httpx2
import pytest

from service.server.pages.routes import IMPORT_MAP, STATIC
from tests.service.waiting import PATIENCE_S

CAPTURE, JOB = "cap_0123456789abcdefghjk", "job_0123456789abcdefghjk"
PAGES = ["/", "/machines", "/captures", f"/captures/{CAPTURE}", "/jobs", f"/jobs/{JOB}", f"/light/{CAPTURE}",
         f"/object/{CAPTURE}", f"/maps/{JOB}", f"/asset/{JOB}", f"/drive/{JOB}"]


class Document(HTMLParser):
    """What matters of a document here."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.identifiers: list[str] = []
        self.labelled: set[str] = set()
        self.controls: list[str] = []
        self.inline: list[str] = []
        self._script: dict[str, str | None] | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attributes) -> None:
        found = dict(attributes)
        self.loads += [found[name] for name in ("src", "href") if tag in ("script", "link", "img") and name in found]
        self.inline += [name for name in found if name.startswith("on") or name == "style"]
        if "id" in found:
            self.identifiers.append(found["id"])
        if tag == "label" and "for" in found:
            self.labelled.add(found["for"])
        if tag in ("select", "textarea") or (tag == "input" and "id" in found and found["id"].count("-")):
            self.controls.append(found["id"])
        self._script = found if tag == "script" else None

    def handle_data(self, data: str) -> None:
        if self._script is not None and self._script.get("type") != "importmap" and data.strip():
            self.inline.append(data)


@pytest.fixture(scope="module")
def client(without_worker) -> Iterator[httpx2.Client]:
    with httpx2.Client(base_url=without_worker, timeout=PATIENCE_S) as made:
        yield made


@pytest.fixture(scope="module")
def is_kept(client) -> Callable[[str], bool]:
    """Whether what a page loads is there and a browser keeps it; each address is asked for once."""
    @cache
    def look(address: str) -> bool:
        loaded = client.get(address)
        return loaded.status_code == 200 and "immutable" in loaded.headers["cache-control"]

    return look


@pytest.mark.parametrize("path", PAGES)
def test_a_page_is_complete_and_its_policy_allows_this_origin_alone(client, is_kept, path):
    answer = client.get(path)
    assert answer.status_code == 200 and answer.headers["content-type"].startswith("text/html")
    found = Document(answer.text)
    assert found.inline == []
    assert len(found.identifiers) == len(set(found.identifiers))
    assert set(found.controls) - {"key-value"} <= found.labelled
    assert [address for address in found.loads if not address.startswith(f"{STATIC}/") or not is_kept(address)] == []
    headers = answer.headers
    policy = dict(part.split(" ", 1) for part in headers["content-security-policy"].split("; "))
    assert policy["default-src"] == "'none'" and policy["frame-ancestors"] == "'none'" and policy["base-uri"] == "'none'"
    assert re.fullmatch(r"'self' 'sha256-[A-Za-z0-9+/=]{44}'", policy["script-src"])
    assert policy["style-src"] == "'self'"
    for sources in policy.values():
        assert not re.search(r"https?:|\*|unsafe", sources)
    assert headers["x-content-type-options"] == "nosniff"


def test_what_a_page_of_another_version_loads_is_not_kept(client):
    for address in ("/static/api.js", "/static/v-of-yesterday/api.js"):
        assert client.get(address).headers["cache-control"] == "no-cache"


VENDORED = Path(__file__).resolve().parents[4] / "service/server/pages/static/vendor/three"
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
