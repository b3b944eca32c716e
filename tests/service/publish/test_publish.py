"""relit publish: what is refused, what is replaced, and that nothing is left half-written."""

import json
from dataclasses import replace

import pytest

from service.publish.publish import publish
from service.requests.publish import PublishRequest
from stage.results.maps import SurfaceMaps
from tests.scenes.captures import edit_frame, files_in, make_scene, write_capture
from tests.service.recording import Recording

IIIF = ["--as", "iiif", "--url", "https://museum.org/cap"]


@pytest.fixture
def cap(tmp_path):
    return write_capture(tmp_path / "cap", make_scene(lights=5))


@pytest.mark.parametrize(("options", "words"), [
    (["--as", "iiif"], "--url is missing"),
    (["--as", "iiif", "--url", "museum.org"], "begins with http"),
    (["--as", "iiif", "--url", "https://"], "begins with http"),
    (["--as", "iiif", "--url", "https://museum.org/cap?a=1"], "address of a folder"),
    ([*IIIF, "--rights", "http://creativecommons.org/licenses/by/4.0/ and more"], "--rights is"),
    ([*IIIF, "--rights", "all mine"], "--rights is all mine"),
    (["--as", "web", "--url", "https://a.b"], "--url is for --as iiif"),
    (["--as", "openlime", "--attribution", "me"], "--attribution is for --as iiif and --as web"),
    (["--as", "web", "--quality", "101"], "--quality"),
    (["--as", "gif"], "--as"),
])
def test_options_that_do_not_fit_are_refused(relit, tmp_path, cap, options, words):
    relit("publish", cap, "--to", tmp_path / "out", *options).refused(words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("notes", "words"), [
    ("{", "is no JSON"), ("[" * 200_000, "is no JSON"),
    ('[{"body": "a", "target": {"selector": {"type": "PointSelector", "x": 1%s, "y": 1}}}]' % ("0" * 400), "annotation 1: has no place"),
    ('[{"body": "a", "target": {"selector": {"type": "PointSelector", "x": true, "y": 1}}}]', "annotation 1: has no place"),
    ('{"items": 3}', "is no list of annotations"),
    ('[{"target": "#xywh=1,1,2,2"}]', "annotation 1: has no text"),
    ('[{"body": "a", "target": {"selector": {"type": "SvgSelector", "value": "<svg/>"}}}]', "annotation 1: has no place"),
    ('[{"body": "a", "target": "#xywh=1,1,2,2"}, {"body": "b", "target": "#xywh=1,1,99,2"}]', "annotation 2: lies outside the image"),
])
def test_annotations_that_cannot_be_shown_are_named(relit, tmp_path, cap, notes, words):
    (tmp_path / "notes.json").write_text(notes)
    relit("publish", cap, "--to", tmp_path / "out", "--as", "web", "--annotations", tmp_path / "notes.json").refused(words)
    assert {path.name for path in tmp_path.iterdir()} == {"cap", "notes.json"}


def test_two_lights_are_too_few(relit, tmp_path):
    cap = write_capture(tmp_path / "cap", make_scene(lights=3))
    edit_frame(cap, 2, light={"type": "distant", "direction": [0, 0.6, -0.8], "irradiance": [1, 1, 1]})
    relit("publish", cap, "--to", tmp_path / "out", "--as", "web").refused("2 are lit from in front")


def test_a_folder_with_other_files_is_kept_and_an_older_publication_replaced(relit, tmp_path, cap):
    other = tmp_path / "mine"
    other.mkdir()
    (other / "thesis.txt").write_text("years of work")
    relit("publish", cap, "--to", other, "--as", "web").refused("holds thesis.txt, which relit publish has not made")
    relit("publish", cap, "--to", cap, "--as", "web").refused("which relit publish has not made")
    (other / "publication.json").write_text('{"@context": "https://www.w3.org/ns/pub-context", "entries": ["thesis.txt"]}')
    relit("publish", cap, "--to", other, "--as", "web").refused("holds thesis.txt")  # a publication of others
    (other / "publication.json").unlink()
    relit.done("publish", cap, "--to", tmp_path / "out", *IIIF)
    relit.done("publish", cap, "--to", tmp_path / "out", "--as", "web")
    (tmp_path / "out" / "CNAME").write_text("museum.org")
    relit("publish", cap, "--to", tmp_path / "out", "--as", "web").refused("holds CNAME")
    (tmp_path / "out" / "CNAME").unlink()
    (tmp_path / "link").symlink_to(tmp_path / "out")
    relit.done("publish", cap, "--to", tmp_path / "link", "--as", "web")
    assert (tmp_path / "link").is_symlink()
    (tmp_path / "link").unlink()
    assert not (tmp_path / "out" / "manifest.json").exists() and (tmp_path / "out" / "index.html").exists()
    assert json.loads((tmp_path / "out" / "publication.json").read_text())["as"] == "web"
    assert {path.name for path in tmp_path.iterdir()} == {"cap", "mine", "out"} and files_in(other) == {"thesis.txt"}


def test_an_interruption_keeps_the_older_publication(relit, tmp_path, cap):
    relit.done("publish", cap, "--to", tmp_path / "out", *IIIF)
    before = files_in(tmp_path / "out")

    class Interrupting(Recording):
        def stage(self, name, total):
            super().stage(name, total)
            if name == "write":
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        publish(PublishRequest(capture=cap, out=tmp_path / "out", kind="web"), Interrupting())
    assert files_in(tmp_path / "out") == before and {path.name for path in tmp_path.iterdir()} == {"cap", "out"}


def test_a_title_is_text_and_no_markup(relit, tmp_path, cap):
    title = '<script>alert("1")</script> $title & more'
    relit.done("publish", cap, "--to", tmp_path / "out", "--as", "web", "--title", title, "--attribution", "<i>us</i>")
    page = (tmp_path / "out" / "index.html").read_text()
    assert page.count("<script") == 1 and "<i>us" not in page
    assert "&lt;script&gt;alert(&quot;1&quot;)&lt;/script&gt; $title &amp; more" in page


def test_a_folder_of_results_stands_for_its_capture_and_shows_its_maps(relit, tmp_path, cap):
    relit.done("solve", cap, "--method", "lambert", "--out", tmp_path / "maps")
    for name, given in (("results", [tmp_path / "maps"]), ("both", [cap, "--maps", tmp_path / "maps"])):
        relit.done("publish", *given, "--to", tmp_path / name, *IIIF)
    assert files_in(tmp_path / "results") == files_in(tmp_path / "both")
    relit.done("publish", tmp_path / "maps", "--to", tmp_path / "page", "--as", "web")
    maps = SurfaceMaps.read(tmp_path / "maps" / "maps.exr")
    replace(maps, normal=0.5 + 0.5 * maps.normal).write(tmp_path / "maps" / "maps.exr")
    relit("publish", tmp_path / "maps", "--to", tmp_path / "none", *IIIF).refused("not 1, as where they are stored as 0…1")
    cap.rename(tmp_path / "elsewhere")
    relit("publish", tmp_path / "maps", "--to", tmp_path / "none", *IIIF).refused("which is not there")
