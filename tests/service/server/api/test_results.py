"""Results: listed while they are made, downloaded whole and in parts, and nothing but results."""

import asyncio
import http.client
import os
import random
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.requests.base.identifiers import CAPTURE, new_id
from service.requests.jobs import SolveJob
from service.server.api.problems import ApiError
from service.server.api.results import asked_range, tag_matches
from service.server.base.settings import Settings
from service.server.storage.folder import FolderStorage, OpenFile
from stage.errors import StorageError
from stage.formats import exr
from stage.results import small_picture
from tests.service.server.api.asgi import Call, app_of
from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import ENDED, NOBODY, finished, made_by, refused, report_of, result, submit, succeeded
from tests.service.server.api.test_watch import queue
from tests.service.server_process import Server

FRAMES = 40
LARGE = 64 << 20
"""More than the sockets between server and client hold, so that a download of it is under way for as long as nobody reads."""


@pytest.fixture(scope="module")
def folder(server) -> Path:
    """The folder of the results of a job that has made frames."""
    made = succeeded(server, SolveJob(kind="solve", capture=new_id(CAPTURE)))
    for number in range(1, FRAMES + 1):
        (made / f"frame.{number:04d}.exr").write_bytes(random.Random(number).randbytes(1000 + number))
    return made


@pytest.fixture(scope="module")
def frames(folder) -> str:
    """The job."""
    return folder.name


@pytest.fixture
def results(folder) -> Iterator[Path]:
    """The folder of the results, from which all that a test puts beside the frames goes afterwards."""
    yield folder
    for path in folder.iterdir():
        if path.is_symlink() or (path.is_file() and not path.name.startswith("frame.")):
            path.unlink()
        elif path.is_dir():
            shutil.rmtree(path)


def raw(server: Server, method: str, path: str) -> tuple[int, bytes]:
    """A request whose path is sent as it is."""
    address = urlsplit(server.url)
    connection = http.client.HTTPConnection(address.hostname, address.port, timeout=60)
    try:
        connection.request(method, path)
        response = connection.getresponse()
        return response.status, response.read()
    finally:
        connection.close()


@pytest.mark.long
def test_results_name_no_place_of_the_server(server, client, dome, sky):
    """Whoever may read a project need not learn where the server keeps it; captures are named by their identifiers."""
    job = finished(server, client, kind="pipeline", capture=dome, environment=sky, guided=True, relight={"frames": "1-2"},
               solve={"method": "lambert"})
    names = made_by(client, job)
    assert {"report.json", "maps.exr", "frame.0001.exr"} <= names
    for name in names:
        content = result(client, job, name)
        for place in (str(server.data.parent), str(SAMPLES), os.getcwd()):
            assert place.encode() not in content, (name, place)
    assert report_of(server, client, job)["options"]["capture"] == dome


@pytest.mark.long
def test_what_is_listed_while_a_job_runs_is_complete(client, dome, sky):
    frames = submit(client, kind="relight", capture=dome, environment=sky, options={"frames": f"1-{FRAMES}"})["id"]
    seen: dict[str, bytes] = {}
    while client.get(f"/v1/jobs/{frames}").json()["state"] not in ENDED:
        listed = client.get(f"/v1/jobs/{frames}/results").raise_for_status().json()["results"]
        for file in listed:
            if file["name"] not in seen:
                seen[file["name"]] = client.get(file["url"]).raise_for_status().content
                assert len(seen[file["name"]]) == file["size"]
        time.sleep(0.02)
    after = client.get(f"/v1/jobs/{frames}/results").json()["results"]
    assert [file["name"] for file in after] == [f"frame.{number:04d}.exr" for number in range(1, FRAMES + 1)]
    for name, content in seen.items():
        assert client.get(f"/v1/jobs/{frames}/results/{name}").content == content


def test_the_listing_comes_a_page_at_a_time_of_a_job_that_is_there(client, frames, folder):
    whole = client.get(f"/v1/jobs/{frames}/results").json()
    assert whole["next"] is None
    found, after = [], {}
    while after is not None:
        page = client.get(f"/v1/jobs/{frames}/results", params={"limit": 15, **after}).raise_for_status().json()
        found += page["results"]
        after = None if page["next"] is None else {"after": page["next"]}
    assert found == whole["results"] and len(found) == FRAMES
    for path in ("", "/frame.0001.exr"):
        refused(client.get(f"/v1/jobs/{NOBODY}/results{path}"), 404, "")
    assert client.request("DELETE", f"/v1/jobs/{frames}/results/frame.0001.exr").headers["Allow"] == "GET, HEAD"
    refused(client.get(f"/v1/jobs/{frames}/results", params={"limit": 1001}), 422, "query.limit")


def test_a_file_is_downloaded_with_what_clients_need_and_not_sent_again(client, frames, folder):
    url, content = f"/v1/jobs/{frames}/results/frame.0001.exr", (folder / "frame.0001.exr").read_bytes()
    response = client.get(url)
    assert (response.status_code, response.content) == (200, content)
    assert response.headers["Content-Type"] == "image/x-exr"
    assert response.headers["Content-Disposition"] == 'attachment; filename="frame.0001.exr"'
    assert response.headers["X-Content-Type-Options"] == "nosniff"
    assert response.headers["Accept-Ranges"] == "bytes"
    assert response.headers["ETag"].startswith('"') and response.headers["ETag"].endswith('"')
    head = client.head(url)
    assert (head.status_code, head.content) == (200, b"")
    same = ("Content-Type", "Content-Length", "Content-Disposition", "ETag", "Last-Modified", "Accept-Ranges")
    assert {name: head.headers[name] for name in same} == {name: response.headers[name] for name in same}
    url = f"/v1/jobs/{frames}/results/frame.0002.exr"
    etag = client.get(url).headers["ETag"]
    for method in ("GET", "HEAD"):
        for given_tags in (etag, f'"other", {etag}', f"W/{etag}", "*"):
            response = client.request(method, url, headers={"If-None-Match": given_tags})
            assert (response.status_code, response.content, response.headers["ETag"]) == (304, b"", etag)
        assert client.request(method, url, headers={"If-None-Match": '"other"'}).status_code == 200
        assert client.request(method, url, headers={"If-Match": etag}).status_code == 200
        response = client.request(method, url, headers={"If-Match": f'W/{etag}, "other"'})  # weak tags are never the same
        assert (response.status_code, response.headers["ETag"]) == (412, etag)


@pytest.mark.parametrize("name, media_type", [
    ("maps.exr", "image/x-exr"), ("asset.usdz", "model/vnd.usdz+zip"), ("asset.usda", "model/vnd.usda"),
    ("asset.glb", "model/gltf-binary"),
    ("asset.usdc", "application/octet-stream"), ("report.json", "application/json"), ("preview.png", "image/png"),
    ("points.ply", "application/octet-stream"), ("page.html", "application/octet-stream"), ("none", "application/octet-stream")])
def test_media_types(client, frames, results, name, media_type):
    (results / name).write_bytes(b"{}")
    assert client.get(f"/v1/jobs/{frames}/results/{name}").headers["Content-Type"] == media_type


def test_a_name_beyond_ascii_keeps_its_name(client, frames, results):
    (results / "step 1").mkdir()
    (results / "step 1" / "Über.exr").write_bytes(b"x")
    file = client.get(f"/v1/jobs/{frames}/results", params={"after": "step"}).json()["results"][0]
    assert (file["name"], file["url"]) == ("step 1/Über.exr", f"/v1/jobs/{frames}/results/step%201/%C3%9Cber.exr")
    response = client.get(file["url"])
    assert response.content == b"x"
    assert response.headers["Content-Disposition"] == "attachment; filename*=UTF-8''%C3%9Cber.exr"


def test_parts(client, frames, folder):
    url, content = f"/v1/jobs/{frames}/results/frame.0003.exr", (folder / "frame.0003.exr").read_bytes()
    size = len(content)
    for wanted, start, part in (("0-9", 0, content[:10]), ("10-10", 10, content[10:11]), (f"{size - 3}-", size - 3, content[-3:]),
                                ("-7", size - 7, content[-7:]), (f"-{size + 5}", 0, content), (f"5-{size + 100}", 5, content[5:])):
        response = client.get(url, headers={"Range": f"bytes={wanted}"})
        assert (response.status_code, response.content) == (206, part)
        assert response.headers["Content-Range"] == f"bytes {start}-{start + len(part) - 1}/{size}"
        assert int(response.headers["Content-Length"]) == len(part)
    for ignored in ("lines=0-9", "bytes=9-3", "bytes=x", "bytes=", "bytes=-", "bytes=5-9, -3"):
        response = client.get(url, headers={"Range": ignored})
        assert (response.status_code, response.content) == (200, content)
    for outside in (f"bytes={size}-", "bytes=-0"):
        response = client.get(url, headers={"Range": outside})
        assert (response.status_code, response.headers["Content-Range"]) == (416, f"bytes */{size}")
        assert response.headers["Content-Type"] == "application/problem+json"


def test_a_download_is_gone_on_with_only_where_the_file_is_the_same(client, frames, results):
    path = results / "other.bin"
    path.write_bytes(b"0123456789")
    url = f"/v1/jobs/{frames}/results/other.bin"
    etag = client.get(url).headers["ETag"]
    response = client.get(url, headers={"Range": "bytes=4-", "If-Range": etag})
    assert (response.status_code, response.content) == (206, b"456789")
    replace(path, b"abcdefghij")
    response = client.get(url, headers={"Range": "bytes=4-", "If-Range": etag})
    assert (response.status_code, response.content) == (200, b"abcdefghij")
    assert response.headers["ETag"] != etag
    for unclear in (f"W/{response.headers['ETag']}", response.headers["Last-Modified"]):
        assert client.get(url, headers={"Range": "bytes=4-", "If-Range": unclear}).status_code == 200


def replace(path: Path, content: bytes) -> None:
    """As the writers of results do."""
    new = path.with_name(f".{path.name}.new")
    new.write_bytes(content)
    os.replace(new, path)


def test_a_download_is_of_one_file_whatever_takes_its_place(client, frames, results):
    path = results / "large.bin"
    path.write_bytes(b"a" * LARGE)
    with client.stream("GET", f"/v1/jobs/{frames}/results/large.bin") as response:
        pieces = response.iter_bytes()
        got = [next(pieces)]
        replace(path, b"b" * 10)
        got += pieces
    whole = b"".join(got)
    assert len(whole) == LARGE and whole.count(b"a") == LARGE


TRICKS = ["..", "../", "../../../../relit.sqlite", "..%2f..%2f..%2f..%2frelit.sqlite", "%2e%2e/%2e%2e/%2e%2e/%2e%2e/relit.sqlite",
          "/etc/passwd", "%2fetc%2fpasswd", "./frame.0001.exr", "x/../frame.0001.exr", "frame.0001.exr/", "frame.0001.exr/.",
          "frame.0001.exr%00", "frame.0001.exr%00.json", "frame.0001.exr%0a", ".hidden", "a/.hidden", "..%5c..%5crelit.sqlite",
          "C:%5cwindows", "%e2%80%aeframe.0001.exr", "a" * 300, "a/" * 500 + "a", ""]
ABSENT = ["%c0%ae%c0%ae/frame.0001.exr", "%ff", "~root", "%252e%252e", "frame.0001.EXR", "frame.9999.exr"]
"""Names like any other, of which there is no file."""


@pytest.mark.parametrize("name", TRICKS + ABSENT)
@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_names_with_tricks_are_not_there(server, frames, folder, method, name):
    (folder / ".hidden").write_bytes(b"x")
    status, body = raw(server, method, f"/v1/jobs/{frames}/results/{name}")
    assert status == 404
    assert method == "HEAD" or b"has no such result" in body


def test_links_out_of_the_results_are_not_followed(server, client, frames, results):
    (results / "link.exr").symlink_to(server.data / "relit.sqlite")
    (results / "inner").symlink_to(server.data, target_is_directory=True)
    listed = {file["name"] for file in client.get(f"/v1/jobs/{frames}/results").json()["results"]}
    assert not any(name.startswith(("link", "inner")) for name in listed)
    assert client.get(f"/v1/jobs/{frames}/results/link.exr").status_code == 404
    assert client.get(f"/v1/jobs/{frames}/results/inner/relit.sqlite").status_code == 404
    assert client.get(f"/v1/jobs/{frames}/results/inner/projects/default/jobs/{frames}/frame.0001.exr").status_code == 404


class Untouched(FolderStorage):
    """A storage that nobody may open a file of."""

    def open(self, prefix: str, name: str) -> Path | None:
        raise StorageError(f"{name!r} was looked for")


def test_pictures_are_made_of_whole_images_of_known_colours_and_bounded_size(tmp_path, monkeypatch):
    planes = {channel: np.full((600, 300), 0.5, np.float16) for channel in "RGBA"}
    with app_of(Settings(data=tmp_path, anonymous=True)) as app:
        job = queue(app.state.service.database, "default")
        folder = tmp_path / "projects/default/jobs" / job
        folder.mkdir(parents=True)
        exr.write(folder / "large.exr", planes, color_space="lin_rec709_scene", metadata={})
        (folder / "cut.exr").write_bytes((folder / "large.exr").read_bytes()[:-100])
        exr.write(folder / "odd.exr", planes, color_space="of no configuration", metadata={})
        exr.write(folder / "many.exr", planes | {"more": planes["A"]}, color_space="lin_rec709_scene", metadata={})

        def answer(name: str) -> Call:
            return asyncio.run(Call(app, f"/v1/jobs/{job}/pictures/{name}").run())

        (tmp_path / "shown.jpg").write_bytes(answer("large.exr").body)
        shown = oiio.ImageBuf(str(tmp_path / "shown.jpg")).get_pixels(oiio.FLOAT)
        assert shown.shape == (300, 150, 3)  # one of two in a row, so that the longest side is at most 512
        assert np.abs(shown - (0.735 + 0.5 * 0.2)).max() < 0.01  # 0.5 as sRGB encodes it, over grey; eight bits and JPEG
        monkeypatch.setattr(small_picture, "MOST_VALUES", 4 * 600 * 300)
        assert {name: answer(name).status for name in ("large.exr", "cut.exr", "odd.exr", "many.exr", "../large.exr", "no.exr")} == {
            "large.exr": 200, "cut.exr": 422, "odd.exr": 422, "many.exr": 422, "../large.exr": 404, "no.exr": 404}


def test_names_with_tricks_never_reach_the_storage(tmp_path):
    with app_of(Settings(data=tmp_path, anonymous=True)) as app:
        job = queue(app.state.service.database, "default")
        app.state.service = app.state.service._replace(storage=Untouched(tmp_path))

        def status(name: str) -> int:
            return asyncio.run(Call(app, f"/v1/jobs/{job}/results/{name}").run()).status

        assert status("maps.exr") == 507
        assert {name: status(name) for name in TRICKS} == dict.fromkeys(TRICKS, 404)


@pytest.mark.long
@given(st.text())
def test_any_range_and_any_tag_can_be_said(text):
    with suppress(ApiError):
        part = asked_range(text, OpenFile("x.bin", 0, 10, 0.0, "a"))
        assert part is None or 0 <= part.start < part.stop <= 10
    assert tag_matches(text, '"a"', strong=True) <= tag_matches(text, '"a"', strong=False)
