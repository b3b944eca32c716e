"""Annotations: kept with a capture, in the format of W3C that relit publish takes, exported with its assets, and gone with it."""

import json

import pytest

from service.client import Client
from service.publish.annotations import read_annotations
from service.requests.base.identifiers import ANNOTATION, new_id
from service.server.database import annotations
from tests.service.server.api.captures import write_capture
from tests.service.server.api.conftest import SAMPLES
from tests.service.server.api.job_calls import admitted, finish, made_by, refused, submit

POINT = {"body": {"type": "TextualBody", "value": "<b>The\nmiddle"}, "target": {"selector": {"type": "PointSelector", "x": 4, "y": 3.5}}}
REGION = {"body": {"type": "TextualBody", "value": "A repair"},
          "target": {"selector": {"type": "FragmentSelector", "value": "xywh=pixel:1,2,3,6"}}}


@pytest.fixture(scope="module")
def noted(server, client, registered) -> str:
    """A capture of 8 × 8 pixels with two annotations."""
    capture = admitted(server, client, write_capture(registered / "noted"))["id"]
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


def test_a_capture_has_so_many_and_no_more(client, noted, monkeypatch, server):
    full = admitted(server, client, SAMPLES / "lambert")["id"]
    path = f"/v1/captures/{full}/annotations"
    with server.database() as database:
        for _ in range(annotations.MOST):
            database.transact(lambda connection: annotations.insert(connection, full, POINT | {"type": "Annotation"}))
    refused(client.post(path, json=POINT), 409, f"has {annotations.MOST} annotations already")
    assert client.delete(f"/v1/captures/{full}").status_code == 204
    with server.database() as database:
        assert annotations.listing(database, full) == []
    refused(client.get(path), 404, full)


def test_the_client_adds_and_deletes_them(server, client, registered):
    capture = admitted(server, client, write_capture(registered / "annotated"))["id"]
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
    solve = finish(server, client, submit(client, kind="solve", capture=noted, options={"method": "lambert"}))
    export = finish(server, client, submit(client, kind="export", maps=solve["id"]))
    assert "annotations.json" in made_by(client, export)
    file = client.get(f"/v1/jobs/{export['id']}/results/annotations.json").raise_for_status()
    assert json.loads(file.content) == client.get(f"/v1/captures/{noted}/annotations").json()
