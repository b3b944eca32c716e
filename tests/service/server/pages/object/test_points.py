"""The points of a depth on the page of its maps: where they lie, how they are coloured, and which are unsure."""

import re

import numpy as np
import pytest

from service.requests.base.identifiers import CAPTURE, new_id
from service.requests.jobs import DepthJob
from stage.formats import exr
from tests.service.server.api.job_calls import admitted, succeeded
from tests.service.server.pages.axe import assert_accessible
from tests.service.server.pages.conftest import SAMPLES, WITHOUT_WEBGL, await_whole, done, expect
from tests.service.server.pages.frames import pixels

pytestmark = pytest.mark.long

LOADED_MS = 120_000
"""Time for the points to be drawn on a loaded machine, where the processor renders WebGL."""
DIGITS = 2e-3
"""Relative error of numbers with four significant digits, and what it makes of a difference between two of them."""


@pytest.fixture
def page(small_page):
    return small_page


@pytest.fixture(scope="module")
def depth(server, client) -> tuple[str, str]:
    """The job of a depth, and that of its view."""
    capture = admitted(server, client, SAMPLES / "rig")["id"]
    made = done(server, client, {"kind": "depth", "capture": capture})
    return made, done(server, client, {"kind": "view", "capture": capture, "maps": made})


@pytest.fixture
def cloud(page, depth):
    page.goto(f"/maps/{depth[0]}")
    page.wait_for_function("() => globalThis.cloud !== undefined", timeout=LOADED_MS)
    return page


def picture(page) -> np.ndarray:
    return pixels(page, "cloud.picture().pixels")


def test_each_colouring_is_another_picture_of_the_same_points_of_which_the_unsure_can_be_hidden(cloud, client, depth):
    pictures = []
    for name in ("depth", "confidence", "photograph"):
        cloud.get_by_label("Colour by").select_option(name)
        cloud.wait_for_function("(name) => globalThis.cloud.state().by === name", arg=name)
        pictures.append(picture(cloud))
    assert (pictures[0][:, 3] > 0).mean() > 0.1
    for other in pictures[1:]:
        assert np.array_equal(pictures[0][:, 3] > 0, other[:, 3] > 0)
        assert not np.array_equal(pictures[0], other)
    points = client.get(f"/v1/jobs/{depth[1]}/results/view.json").json()["points"]
    assert points["unsure"] > 0
    shown = "(count) => globalThis.cloud.state().shown === count"
    cloud.wait_for_function(shown, arg=points["count"] + points["unsure"])
    cloud.get_by_label("Show unsure points").uncheck()
    cloud.wait_for_function(shown, arg=points["count"])


def test_a_chosen_point_is_one_of_the_depth(cloud, client, depth, tmp_path):
    """The point in the middle, read by the keyboard, lies where depth.exr has it."""
    cloud.locator("canvas.scene").focus()
    cloud.keyboard.press("Enter")
    chosen, numbers = cloud.locator("output", has_text="camera frame"), re.compile(r"x (\S+), y (\S+), z (\S+) m .*?depth (\S+) m")
    expect(chosen).to_have_text(numbers)
    x, y, z, away = (float(value) for value in numbers.search(chosen.inner_text().replace("−", "-")).groups())
    assert away == -z
    path = tmp_path / "depth.exr"
    path.write_bytes(client.get(f"/v1/jobs/{depth[0]}/results/depth.exr").raise_for_status().content)
    camera = client.get(f"/v1/jobs/{depth[1]}/results/view.json").json()["camera"]
    channels, _ = exr.read(path)
    u = camera["principal_px"][0] + camera["focal_px"][0] * x / away
    v = camera["principal_px"][1] - camera["focal_px"][1] * y / away
    near = channels["depth.Z"][int(v) - 1 : int(v) + 2, int(u) - 1 : int(u) + 2]
    assert np.abs(near / away - 1).min() < DIGITS


def test_without_webgl_the_maps_remain(page, depth):
    page.add_init_script(WITHOUT_WEBGL)
    page.goto(f"/maps/{depth[0]}")
    page.get_by_text("This browser has no WebGL2, which the points need").wait_for(timeout=LOADED_MS)
    expect(page.locator("canvas.map")).to_be_visible()


def test_no_violation(open_to_axe, depth):
    page = open_to_axe
    page.set_viewport_size({"width": 390, "height": 844})
    page.goto(f"/maps/{depth[0]}")
    page.wait_for_function("() => globalThis.cloud !== undefined", timeout=LOADED_MS)
    await_whole(page)
    assert_accessible(page, 390)


def test_other_scans_are_chosen_to_be_fused(page, server, client, depth):
    """The capture of the other scan was deleted; its depth goes by the name of its job, which is hostile."""
    name = "<img src=x onerror=alert(1)> other side"
    page.on("dialog", lambda dialog: pytest.fail(dialog.message))
    other = succeeded(server, DepthJob(kind="depth", capture=new_id(CAPTURE), name=name)).name
    capture = client.get(f"/v1/jobs/{depth[0]}").json()["request"]["capture"]
    page.goto(f"/object/{capture}")
    page.get_by_text("Fuse with other scans").click()
    page.get_by_role("button", name="Find the poses").click()
    page.get_by_text("Choose at least one other scan.").wait_for()
    page.get_by_label(name, exact=True).check()
    with page.expect_response(lambda answer: answer.request.method == "POST" and answer.url.endswith("/v1/jobs")) as answered:
        page.get_by_role("button", name="Find the poses").click()
    assert answered.value.status == 202
    made = answered.value.json()
    assert made["request"]["kind"] == "register" and made["request"]["depths"] == [depth[0], other]
    page.locator(f"a[href='/jobs/{made['id']}']").first.wait_for()
    client.post(f"/v1/jobs/{made['id']}/cancel")
    server.wait(client, f"/v1/jobs/{made['id']}", ("cancelled", "failed"))
    for each in (made["id"], other):  # other tests share the server
        client.delete(f"/v1/jobs/{each}").raise_for_status()
