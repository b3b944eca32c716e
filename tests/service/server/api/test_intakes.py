"""Captures and environments: created or registered, looked at, checked, annotated, deleted."""

import shutil

import pytest

from service.client import Client
from service.publish.annotations import read_annotations
from service.requests.base.identifiers import ANNOTATION, CAPTURE, new_id
from service.requests.jobs import CheckJob
from service.server.base.settings import Settings
from service.server.database import intakes, jobs
from service.server.database.jobs import Claim
from tests.marks import first_short
from tests.service.server.api.captures import write_capture
from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import admitted, checked, finish, finished, made_by, refused, report_of, submit
from tests.service.server.api.tus import Tus, encoded
from tests.service.server.prepared import opened


def test_captures_are_created_looked_at_deleted_and_listed_in_pages(client):
    answer = client.post("/v1/captures", json={"name": "new"})
    made = answer.json()
    assert (answer.status_code, answer.headers["location"]) == (201, f"/v1/captures/{made['id']}")
    assert (made["state"], made["registered"], made["problem"], made["facts"]) == ("receiving", False, None, None)
    assert client.get(f"/v1/captures/{made['id']}").json() == made
    assert client.delete(f"/v1/captures/{made['id']}").status_code == 204
    assert client.get(f"/v1/captures/{made['id']}").status_code == 404
    assert client.delete(f"/v1/captures/{made['id']}").status_code == 404
    made = [client.post("/v1/captures", json={"name": f"page {number}"}).json()["id"] for number in range(3)]
    first = client.get("/v1/captures", params={"limit": 2}).json()
    second = client.get("/v1/captures", params={"limit": 2, "before": first["next"]}).json()
    assert [item["id"] for item in first["items"] + second["items"]][:3] == made[::-1]
    assert all(item["id"].startswith("env_") for item in client.get("/v1/environments").json()["items"])


@pytest.mark.long
def test_a_registered_capture_is_checked_at_once_and_stays_where_it_lies(server, client, registered):
    folder = write_capture(registered / "kept")
    ready = admitted(server, client, folder)
    assert ready["facts"] == {"captures": 1, "frames": 4, "resolution": [8, 8], "color_space": "lin_rec709_scene", "name": "small",
                              "lit_by": ["light"], "calibrated": ["lights"]}
    assert client.post(f"/v1/captures/{ready['id']}/validate").status_code == 409
    assert client.delete(f"/v1/captures/{ready['id']}").status_code == 204
    assert (folder / "capture.json").is_file()
    for step in ("step1", "step2"):
        write_capture(registered / "sequence" / step)
    facts = admitted(server, client, registered / "sequence")["facts"]
    assert (facts["captures"], facts["frames"]) == (2, 8)


@pytest.mark.long
def test_a_registered_capture_is_checked_again_when_mended_and_not_deleted_while_a_job_reads_it(server, client, registered, sky):
    folder = write_capture(registered / "mended")
    kept = (folder / "001.exr").read_bytes()
    (folder / "001.exr").unlink()
    made = admitted(server, client, folder, "refused")
    assert "001.exr is not in the folder" in made["problem"]
    (folder / "001.exr").write_bytes(kept)
    client.post(f"/v1/captures/{made['id']}/validate").raise_for_status()
    assert server.wait(client, f"/v1/captures/{made['id']}", ("ready", "refused"))["state"] == "ready"
    made = admitted(server, client, write_capture(registered / "read"))["id"]
    job = submit(client, kind="relight", capture=made, environment=sky, priority=0, options={"frames": "1-300"})["id"]
    refused(client.delete(f"/v1/captures/{made}"), 409, job)
    client.post(f"/v1/jobs/{job}/cancel").raise_for_status()
    server.wait(client, f"/v1/jobs/{job}", ("cancelled",))
    assert client.delete(f"/v1/captures/{made}").status_code == 204


@first_short("kind", ["captures", "environments"])
def test_what_has_no_file_is_not_checked_and_a_check_begins_again_by_another_validation_alone(server, client, kind):
    made = client.post(f"/v1/{kind}", json={"name": "empty"}).json()["id"]
    refused(client.post(f"/v1/{kind}/{made}/validate"), 409, "has no files yet")
    Tus(server.url).send(f"/v1/{kind}/{made}", "a.exr", b"no image")
    client.post(f"/v1/{kind}/{made}/validate").raise_for_status()
    server.wait(client, f"/v1/{kind}/{made}", ("refused",))
    check = next(job for job in client.get("/v1/jobs").json()["jobs"] if job["request"].get("intake") == made)
    server.wait(client, f"/v1/jobs/{check['id']}", ("failed",))
    refused(client.post(f"/v1/jobs/{check['id']}/retry"), 409, made)


@pytest.mark.parametrize("end", ["cancelled", "lost"])
def test_a_check_that_ends_unseen_leaves_nothing_waiting(tmp_path, end):
    """Cancelled, or the death of worker after worker: what it was to look at is refused, and does not check for ever."""
    with opened(Settings(data=tmp_path)) as database:
        with database.begin() as connection:
            capture = intakes.insert(connection, project="p", kind=CAPTURE, name="test", folder=tmp_path)
            job = jobs.insert(connection, project="p", request=CheckJob(kind="check", intake=capture), inputs=[capture])
        if end == "cancelled":
            assert database.transact(lambda connection: jobs.cancel(connection, job))
        else:
            claim = Claim(job, 1, "worker")
            assert jobs.begin(database, claim)
            assert database.transact(lambda connection: jobs.record_lost_worker(connection, claim, 0)) == jobs.FAILED
        found = intakes.find(database, capture, "p")
        assert found["state"] == "refused"
        assert ("cancelled" if end == "cancelled" else "lost 1 workers") in found["problem"]
        assert database.transact(lambda connection: intakes.begin_check(connection, capture))
        assert not database.transact(lambda connection: jobs.cancel(connection, job))
        assert intakes.find(database, capture, "p")["state"] == "checking"  # the check that ended before has no say in this one


@pytest.mark.long
@pytest.mark.parametrize(("kind", "more"), [
    ("solve", {}), ("depth", {}), ("scan", {"options": {"near_m": 1}}), ("basis", {}), ("inspect-board", {}), ("calibrate-saturation", {})])
def test_a_job_whose_registered_capture_is_gone_does_not_say_where_it_was(server, client, gone, kind, more):
    job = submit(client, kind=kind, capture=gone[0], **more)
    error = finish(server, client, job, "failed")["error"]
    log = client.get(f"/v1/jobs/{job['id']}/log").text
    assert gone[0] in error and "not where it was registered any more" in error, error
    assert not any(str(place) in error + log for place in (gone[1], gone[1].parent, server.data)), error


@pytest.fixture(scope="module")
def gone(server, client, registered):
    """A capture that was registered and checked, whose folder was deleted since, and its folder."""
    folder = write_capture(registered / "gone")
    made = admitted(server, client, folder)["id"]
    shutil.rmtree(folder)
    return made, folder


FILE = SAMPLES / "owl" / "environment.exr"


def test_the_file_is_sent_as_it_is_and_so_is_an_uploaded_one(client, sky, server, tus):
    answer = client.get(f"/v1/environments/{sky}/file")
    assert answer.status_code == 200 and answer.content == FILE.read_bytes()
    assert answer.headers["content-disposition"] == 'attachment; filename="environment.exr"'
    part = client.get(f"/v1/environments/{sky}/file", headers={"Range": "bytes=4-11"})
    assert part.status_code == 206 and part.content == FILE.read_bytes()[4:12]
    place = f"/v1/environments/{client.post('/v1/environments', json={'name': 'sky'}).json()['id']}"
    upload = tus.create(place, FILE.stat().st_size, encoded(path="sky.exr")).headers["location"]
    assert client.get(f"{place}/file").status_code == 409
    assert tus.patch(upload, 0, FILE.read_bytes()).status == 204
    client.post(f"{place}/validate").raise_for_status()
    assert server.wait(client, place, ("ready", "refused"))["state"] == "ready"
    answer = client.get(f"{place}/file")
    assert answer.content == FILE.read_bytes() and 'filename="sky.exr"' in answer.headers["content-disposition"]
    assert client.get("/v1/environments/env_0123456789abcdefghjk/file").status_code == 404


@pytest.mark.long
@pytest.mark.parametrize("how", ["link", "gone"])
def test_a_registered_file_that_became_a_link_is_not_sent(server, client, registered, tmp_path, how):
    file = registered / f"{how}.exr"
    file.write_bytes(FILE.read_bytes())
    made = admitted(server, client, file, kind="environments")["id"]
    foreign = tmp_path / "foreign.exr"
    foreign.write_bytes(b"foreign")
    file.unlink()
    if how == "link":
        file.symlink_to(foreign)
    refused(client.get(f"/v1/environments/{made}/file"), 404, "not there any more")


POINT = {"body": {"type": "TextualBody", "value": "<b>The\nmiddle"}, "target": {"selector": {"type": "PointSelector", "x": 4, "y": 3.5}}}
REGION = {"body": {"type": "TextualBody", "value": "A repair"},
          "target": {"selector": {"type": "FragmentSelector", "value": "xywh=pixel:1,2,3,6"}}}


@pytest.fixture(scope="module")
def noted(server, client, registered) -> str:
    """A capture of 8 × 8 pixels with two annotations."""
    capture = checked(server, write_capture(registered / "noted"), resolution=[8, 8])
    for each in (POINT, REGION):
        made = client.post(f"/v1/captures/{capture}/annotations", json=each)
        assert made.status_code == 201 and made.json()["id"] == made.headers["location"]
    return capture


def test_the_page_is_the_file_that_publish_takes(client, noted, tmp_path):
    page = client.get(f"/v1/captures/{noted}/annotations").raise_for_status()
    assert page.json()["@context"] == "http://www.w3.org/ns/anno.jsonld" and page.json()["type"] == "AnnotationPage"
    (tmp_path / "notes.json").write_bytes(page.content)
    assert [tuple(each) for each in read_annotations(tmp_path / "notes.json", 8, 8)] == [
        (4, 3.5, 0, 0, "<b>The\nmiddle"), (1, 2, 3, 6, "A repair")]


@pytest.mark.parametrize(("change", "words"), [
    ({"body": {"type": "TextualBody", "value": " \n"}}, "value"),
    ({"body": {"type": "TextualBody", "value": "a" * 2001}}, "value"),
    ({"target": {"selector": {"type": "SvgSelector", "value": "<svg/>"}}}, "selector"),
    ({"target": {"selector": {"type": "PointSelector", "x": 9, "y": 1}}}, "outside the image, which has 8x8 pixels"),
    ({"target": {"selector": {"type": "PointSelector", "x": -1, "y": 1}}}, "x"),
    ({"target": {"selector": {"type": "PointSelector", "x": "1", "y": 1}}}, "x"),
    ({"target": {"selector": {"type": "FragmentSelector", "value": "xywh=1,1,8,1"}}}, "outside the image"),
    ({"target": {"selector": {"type": "FragmentSelector", "value": "xywh=percent:1,1,8,1"}}}, "value")])
def test_what_is_no_annotation_of_the_image_is_refused(client, noted, change, words):
    refused(client.post(f"/v1/captures/{noted}/annotations", json=POINT | change), 422, words)


@pytest.mark.long
def test_a_capture_has_so_many_and_no_more(client, server):
    full = checked(server, SAMPLES / "lambert", resolution=[128, 128])
    path = f"/v1/captures/{full}/annotations"
    with server.database() as database:
        for _ in range(intakes.MOST_ANNOTATIONS):
            database.transact(lambda connection: intakes.annotate(connection, full, POINT | {"type": "Annotation"}))
    refused(client.post(path, json=POINT), 409, f"has {intakes.MOST_ANNOTATIONS} annotations already")
    assert client.delete(f"/v1/captures/{full}").status_code == 204
    with server.database() as database:
        assert intakes.annotations_of(database, full) == []
    refused(client.get(path), 404, full)


def test_the_client_adds_and_deletes_them(server, client, registered):
    capture = checked(server, write_capture(registered / "annotated"), resolution=[8, 8])
    with Client(server.url) as relit:
        point, region = relit.annotations.add(capture, "here", 2, 2.5), relit.annotations.add(capture, "there", 1, 2, 3, 4)
        assert relit.annotations.page(capture).items == [point, region] and region.box() == (1, 2, 3, 4)
        relit.annotations.delete(point)
        assert [each.body.value for each in relit.annotations.page(capture).items] == ["there"]
    refused(client.delete(point.id), 404, "there is no ann_")
    refused(client.delete(f"/v1/captures/{new_id('cap')}/annotations/{new_id(ANNOTATION)}"), 404, "there is no cap_")
    actions = [entry["action"] for entry in client.get("/v1/audit?limit=10").json()["entries"] if entry["object"].startswith("ann_")]
    assert actions[:3] == ["annotation.delete", "annotation.create", "annotation.create"]


@pytest.mark.long
def test_an_export_has_the_annotations_of_its_capture(server, client, noted):
    solve = finished(server, client, kind="solve", capture=noted, options={"method": "lambert"})
    export = finished(server, client, kind="export", maps=solve["id"])
    assert "annotations.json" in made_by(client, export)
    assert report_of(server, client, export, "annotations.json") == client.get(f"/v1/captures/{noted}/annotations").json()
