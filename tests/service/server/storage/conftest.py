"""Storages of every kind, each empty: the data folder, an object store of files, and one that speaks S3 where a server can be had.

RELIT_TEST_S3 names the address of such a server (with the usual AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, which may write anything
there); without it moto's is started where moto is installed.
"""

import importlib.util
import os
import subprocess
import sys
import uuid
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import httpx2
import pytest

from service.server.storage.bucket import Bucket
from service.server.storage.folder import FolderStorage
from service.server.storage.objects import ObjectStorage, Storage
from tests.service.waiting import free_port, until

LIMIT = 1 << 30
BUCKET = "relit-test"


@pytest.fixture(scope="session")
def s3_server() -> Iterator[str]:
    """The address of a server that speaks S3."""
    if named := os.environ.get("RELIT_TEST_S3"):
        yield named
        return
    if importlib.util.find_spec("moto") is None:
        pytest.skip("no S3 server: name one in RELIT_TEST_S3, or install moto[server]")
    port = free_port()
    process = subprocess.Popen([sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)], stdout=subprocess.DEVNULL,
                               stderr=subprocess.DEVNULL)
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        process.kill()
        process.wait()


@pytest.fixture
def s3(s3_server: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """A URL below which a bucket of the server is empty, and the environment that reaches it."""
    for name, value in {"AWS_ENDPOINT_URL": s3_server, "AWS_ALLOW_HTTP": "true", "AWS_REGION": "us-east-1"}.items():
        monkeypatch.setenv(name, value)
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, os.environ.get(name, "test"))

    def answers() -> bool:
        with suppress(httpx2.TransportError):
            return httpx2.put(f"{s3_server}/{BUCKET}", timeout=5).status_code > 0  # there already, or not ours to make: the tests tell
        return False

    until(answers, f"no S3 server answers at {s3_server}", every_s=0.1)
    return f"s3://{BUCKET}/{uuid.uuid4()}"


FILE_OR_S3 = ["file", pytest.param("s3", marks=pytest.mark.long)]


@pytest.fixture(params=FILE_OR_S3)
def url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """The URL of an empty object store."""
    return (tmp_path / "store").as_uri() if request.param == "file" else request.getfixturevalue("s3")


Machine = Callable[[str], Storage]


@pytest.fixture
def machine(url: str, tmp_path: Path) -> Machine:
    """The same object store as machines of these names see it, each with a disk of its own."""
    return lambda name: ObjectStorage(Bucket(url), tmp_path / name, LIMIT)


@pytest.fixture(params=["folder", *FILE_OR_S3])
def storage(request: pytest.FixtureRequest, tmp_path: Path) -> Storage:
    """A storage of each kind."""
    if request.param == "folder":
        return FolderStorage(tmp_path / "data")
    url = (tmp_path / "store").as_uri() if request.param == "file" else request.getfixturevalue("s3")
    return ObjectStorage(Bucket(url), tmp_path / "scratch", LIMIT)
