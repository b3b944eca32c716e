"""Exported assets are shown in 3D under the light that is chosen, and what cannot be shown is said."""

import zipfile

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
from scipy.ndimage import binary_erosion

from tests.service.server.pages.axe import assert_accessible
from tests.service.server.pages.conftest import PAGE_BYTES, WITHOUT_WEBGL, await_whole, count_bytes, done, expect, opened_page, seen
from tests.service.server.pages.frames import pixels

pytestmark = pytest.mark.long

LOADED_MS = 120_000
"""Time for an asset to load and to be lit on a loaded machine, where the processor renders WebGL."""
SHIFT = 0.05
"""Least shift of the brightness from the middle of the object, in its widths. A
patch of light on one side of a ball gives a tenth or more."""

KEEP_CONTEXT = """const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...given) {
  const context = get.call(this, kind, ...given);
  if (kind === "webgl2") globalThis.webgl = context;
  return context;
};"""
"""Keeps the last context of WebGL, whose canvas is not on the page."""

RIM = 4
"""Width of the rim in pixels of the picture, of which the ball is some 200 wide."""


@pytest.fixture
def page(small_page):
    return small_page


@pytest.fixture(scope="module")
def exported(server, client, solved) -> dict[str, str]:
    """The jobs that exported the solved capture, by format."""
    return {form: done(server, client, {"kind": "export", "maps": solved.solve, "format": form}) for form in ("usdz", "glb", "usda")}


@pytest.fixture(scope="module")
def opened(browser, server, exported):
    """A page with the asset as glTF, which is opened once; axe is injected into it."""
    with opened_page(browser, base_url=server.url, viewport={"width": 640, "height": 480}, bypass_csp=True) as page:
        page.add_init_script(KEEP_CONTEXT)
        loaded = count_bytes(page)
        open_asset(page, exported["glb"])
        seen(page, lambda: sum(loaded) > 1_000_000, "three.js is not loaded")
        assert sum(loaded) < PAGE_BYTES
        yield page


@pytest.fixture
def asset(opened):
    """The page as it was opened: in the neutral room, seen from the camera, without the lights of the rig."""
    opened.get_by_label("Lit by").select_option("room")
    opened.get_by_role("button", name="As it was captured").click()
    opened.get_by_label("Lights of the rig").uncheck()
    return opened


def open_asset(page, job: str) -> dict:
    """Open the page of an asset, and hide the lights of the rig, which are no part of it."""
    page.goto(f"/asset/{job}")
    page.wait_for_function("() => globalThis.asset !== undefined", timeout=LOADED_MS)
    await_whole(page)
    page.get_by_label("Lights of the rig").uncheck()
    page.locator("canvas.scene[data-share='1']").wait_for(timeout=LOADED_MS)  # it has its size
    return page.evaluate("() => globalThis.asset.state()")


def shown(page) -> np.ndarray:
    """[rows, cols, 4] uint8 what the view in 3D shows."""
    picture = pixels(page, "(globalThis.taken = asset.picture()).pixels")
    return picture.reshape(page.evaluate("taken.rows"), -1, 4)


def shift_of_light(page) -> np.ndarray:
    """How far to the right and up the brightness lies from the middle of the object, in its widths."""
    picture = shown(page).astype(float)
    row, col = np.indices(picture.shape[:2])
    inside = picture[..., 3] > 0
    weight = picture[..., :3].sum(axis=2) * inside
    width = np.ptp(col[inside])
    right = (col * weight).sum() / weight.sum() - col[inside].mean()
    down = (row * weight).sum() / weight.sum() - row[inside].mean()
    return np.array([right, -down]) / width


def patch(path, direction: tuple[float, float, float]):
    """Write a lat-long map that is bright around a direction: +y is up, +z in the middle, +x a quarter from the left."""
    v, u = (np.indices((32, 64)) + 0.5) / np.array([32, 64])[:, None, None]
    azimuth, polar = 2 * np.pi * u, np.pi * v
    towards = np.stack([np.sin(azimuth) * np.sin(polar), np.cos(polar), -np.cos(azimuth) * np.sin(polar)], axis=-1)
    values = np.where((towards @ np.array(direction) > 0.9)[..., None], 10.0, 0.05).astype(np.float32).repeat(3, axis=2)
    if path.suffix == ".exr":
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"RGB": values}).write(str(path))
    else:
        image = oiio.ImageBuf(values)
        assert image.write(str(path), "float"), image.geterror()
    return path


def light_by(page, path) -> None:
    page.set_input_files("input[type=file]", path)
    page.wait_for_function("(name) => globalThis.asset.state().environment === name", arg=path.name, timeout=LOADED_MS)


def test_the_card_stands_there_until_the_asset_is_drawn(page, exported):
    held = []
    page.route("**/asset.glb", lambda route: held.append(route))
    page.goto(f"/asset/{exported['glb']}")
    page.locator("canvas.scene[data-shown=card]").wait_for()
    seen(page, lambda: held, "the asset is not asked for")
    held.pop().continue_()
    page.locator("canvas.scene[data-shown=live]").wait_for(timeout=LOADED_MS)


def test_gltf_is_shown(asset):
    assert_shown(asset, asset.evaluate("() => globalThis.asset.state()"))


def test_usdz_is_shown(page, exported):
    assert_shown(page, open_asset(page, exported["usdz"]))


def assert_shown(page, state: dict) -> None:
    assert state["triangles"] > 1000 and state["textures"] >= 2 and state["problems"] == []
    picture = shown(page)
    covered = picture[..., 3] > 0
    # the sphere around the object's box, half as wide again as the object, fills the height of the picture but for the margin
    assert 0.4 < np.ptp(np.flatnonzero(covered.any(axis=1))) / len(picture) < 1
    assert picture[..., :3][covered].mean() > 60


def test_an_environment_lights_from_where_it_is_bright_and_turns_as_in_relit_relight(asset, tmp_path):
    for name, side in (("above_right.exr", 1), ("below_left.hdr", -1)):
        light_by(asset, patch(tmp_path / name, (side * np.sqrt(0.5), side * np.sqrt(0.5), 0)))
        assert (side * shift_of_light(asset) > SHIFT).all(), name
    light_by(asset, patch(tmp_path / "front.exr", (0, 0, 1)))  # what shone from the camera (+z) shines from the right (+x)
    assert abs(shift_of_light(asset)[0]) < SHIFT
    asset.get_by_label("Turn (degrees)").fill("90")
    assert shift_of_light(asset)[0] > SHIFT


def test_the_lights_of_the_rig_are_shown_and_light_the_asset(client, asset, solved):
    view = next(job["id"] for job in client.get("/v1/jobs", params={"kind": "view", "limit": 500}).json()["jobs"]
                if job["request"]["capture"] == solved.capture)
    frames = client.get(f"/v1/jobs/{view}/results/view.json").json()["frames"]
    lights = [index for index, frame in enumerate(frames) if frame["kind"] == "light" and frame["direction"] is not None]
    assert len(lights) > 0
    expect(asset.locator("select").first.locator("option")).to_have_count(2 + len(lights))
    hidden = shown(asset)
    asset.get_by_label("Lights of the rig").check()
    assert not np.array_equal(hidden, shown(asset))
    asset.get_by_label("Lights of the rig").uncheck()
    for axis in (0, 1):
        for most in (max, min):
            index = most(lights, key=lambda at: frames[at]["direction"][axis])
            asset.get_by_label("Lit by").select_option(str(index))
            assert np.sign(frames[index]["direction"][axis]) * shift_of_light(asset)[axis] > SHIFT


def test_nothing_sparkles_at_the_rim(asset):
    """In the room and under lights before the ball, which has no highlights, the rim is no brighter than the brightest of the rest, which
    faces up to 74 degrees to the side, as the lights stand. A twentieth is for the solved albedo; nothing is clipped two stops down."""
    lights = asset.locator("select").first.locator("option").evaluate_all("all => all.slice(2).map((each) => each.value)")
    for light in ("room", *lights[::8]):
        asset.get_by_label("Lit by").select_option(light)
        assert shown(asset)[..., :3].max() < 255, light  # nothing is whiter than white that faces the light
        exposure = asset.get_by_label("Exposure (stops)")
        exposure.fill(str(float(exposure.input_value()) - 2))
        picture = shown(asset)
        covered = picture[..., 3] == 255
        inside = binary_erosion(covered, iterations=RIM)
        brightest = picture[..., :3].max(axis=2).astype(float)
        assert 0 < brightest[covered & ~inside].max() <= 1.05 * brightest[inside].max() < 255, light


def test_the_chosen_light_casts_shadows(asset):
    """What is cast makes the picture darker, and nothing brighter than rounding does."""
    pictures = {}
    for light in asset.locator("select").first.locator("option").evaluate_all("all => all.slice(2).map((each) => each.value)"):
        asset.get_by_label("Lit by").select_option(light)
        for shadows in (True, False):
            asset.get_by_label("Shadows").set_checked(shadows)
            pictures[shadows] = shown(asset)[..., :3].astype(int)
        assert (pictures[True] <= pictures[False] + 1).all()
        if (pictures[False] - pictures[True] > 40).any(axis=2).sum() > 50:
            break
    else:
        pytest.fail("no light of the rig casts a shadow on the ball with its hollows")
    asset.get_by_label("Shadows").check()


def test_the_surface_is_drawn_as_clay_as_wires_and_by_its_normals(asset):
    first, seen = shown(asset), []
    for way in ("clay", "wires", "normals", "asset"):
        asset.get_by_label("Surface").select_option(way)
        seen.append(shown(asset))
    clay, wires, normals, again = seen
    assert np.array_equal(first, again) and not any(np.array_equal(first, each) for each in seen[:3])
    inside = clay[..., 3] == 255
    hues = [np.ptp(picture[..., :3][inside].astype(float), axis=1).mean() for picture in (normals, clay)]
    assert hues[0] > 2 * hues[1]  # three colours for three axes, one colour for clay
    assert (wires[..., 3][inside] < 255).any()  # it is seen through


def test_a_distance_is_measured_between_two_points_of_the_object(asset):
    assert asset.evaluate("""async () => {
      const { Mesh, MeshBasicMaterial, OrthographicCamera, PlaneGeometry, Vector3 } = await import("three");
      const { Distance, lengthText } = await import("/static/scene/distance.js");
      const camera = new OrthographicCamera(-1, 1, 1, -1, 0.1, 10);
      camera.position.z = 5;
      camera.updateMatrixWorld();
      const plane = new Mesh(new PlaneGeometry(1.6, 1.6), new MeshBasicMaterial());
      const distance = new Distance(plane, "red");
      const at = (x, y) => distance.take(new Vector3(x, y, 0), camera);
      const found = [at(-0.3, 0), distance.value, at(0.9, 0), at(0, 0.4), +distance.value.toFixed(9), at(0.1, 0), distance.value];
      return [found, [2.5, 0.0321, 0.00321, 4.2e-6].map(lengthText)];
    }""") == [[1, None, None, 2, 0.5, 1, None], ["2.500 m", "3.210 cm", "3.210 mm", "4.200 \u00b5m"]]
    asset.get_by_role("button", name="Measure a distance").click()
    asset.locator("canvas.scene").focus()
    asset.keyboard.press("Enter")
    asset.get_by_text("Choose the other point.").wait_for()
    asset.keyboard.press("Enter")
    asset.wait_for_function("() => globalThis.asset.state().distance === 0")  # the same point twice
    asset.get_by_role("button", name="Measure a distance").click()


def test_a_light_behind_the_object_is_not_chosen_through_it(asset):
    asset.get_by_label("Lights of the rig").check()
    asset.locator("canvas.scene").focus()
    asset.keyboard.press("Enter")  # the middle of the object
    assert asset.evaluate("() => globalThis.asset.state().lit") == "room"


def test_the_keyboard_turns_it_and_it_is_shown_again_when_the_graphics_processor_comes_back(asset):
    first = shown(asset)
    asset.locator("canvas.scene").focus()
    for _ in range(4):
        asset.keyboard.press("ArrowRight")
    seen(asset, lambda: not np.array_equal(first, shown(asset)))
    asset.keyboard.press("0")
    seen(asset, lambda: np.array_equal(first, shown(asset)))
    asset.evaluate("""() => {
      globalThis.lost = webgl.getExtension('WEBGL_lose_context');
      lost.loseContext();
    }""")
    asset.get_by_text("The graphics processor has stopped").wait_for()
    asset.evaluate("() => { delete document.querySelector('canvas.scene').dataset.share; lost.restoreContext(); }")
    asset.locator("canvas.scene[data-share='1']").wait_for()  # without a call for a picture
    asset.get_by_text("The graphics processor has stopped").wait_for(state="detached")
    seen(asset, lambda: np.array_equal(first, shown(asset)))


def test_a_job_without_an_asset_that_can_be_shown_is_said_and_without_webgl_the_file_is_offered(page, exported):
    page.goto(f"/asset/{exported['usda']}")
    page.get_by_text("this job has no asset.usdz or asset.glb").wait_for()
    page.add_init_script(WITHOUT_WEBGL)
    page.goto(f"/asset/{exported['glb']}")
    page.get_by_text("This browser has no WebGL2").wait_for()
    expect(page.get_by_role("link", name="Its job")).to_have_attribute("href", f"/jobs/{exported['glb']}")


@pytest.mark.parametrize("form", ["usdz", "glb"])
def test_a_damaged_asset_is_named(page, exported, form):
    page.route(f"**/results/asset.{form}", lambda route: route.fulfill(body=b"PK" + bytes(500)))
    page.goto(f"/asset/{exported[form]}")
    page.get_by_text(f"asset.{form} cannot be opened").wait_for(timeout=LOADED_MS)


def test_a_map_that_is_none_is_named(asset, tmp_path):
    bad = tmp_path / "bad.exr"
    bad.write_bytes(b"nothing")
    asset.set_input_files("input[type=file]", bad)
    asset.get_by_text("bad.exr: cannot be read as an environment map").wait_for()
    assert asset.evaluate("() => globalThis.asset.state()")["lit"] == "room"


def test_textures_that_are_not_in_the_file_are_named(page, exported, solved, tmp_path):
    """The package without its textures; nothing is asked of the server for them."""
    whole = solved.result(exported["usdz"], "asset.usdz", tmp_path)
    with zipfile.ZipFile(whole) as package, zipfile.ZipFile(tmp_path / "bare.usdz", "w", zipfile.ZIP_STORED) as bare:
        for name in package.namelist():
            if not name.endswith(".png"):
                bare.writestr(name, package.read(name))
    asked = []
    page.on("request", lambda request: asked.append(request.url) if request.url.endswith(".png") else None)
    page.route("**/results/asset.usdz", lambda route: route.fulfill(body=(tmp_path / "bare.usdz").read_bytes()))
    state = open_asset(page, exported["usdz"])
    assert state["problems"] and all("is not in the file" in problem for problem in state["problems"])
    page.locator(".fault", has_text="is not in the file").first.wait_for()
    assert asked == []


def test_no_violation(asset):
    assert_accessible(asset, 390)


def test_a_map_is_shown_without_light_and_a_link_has_the_camera(asset):
    asset.get_by_label("Surface").select_option("albedo")
    in_room = shown(asset)
    asset.get_by_label("Lit by").select_option(index=2)
    assert np.array_equal(shown(asset), in_room)
    asset.get_by_label("Surface").select_option("asset")
    assert not np.array_equal(shown(asset), in_room)
    asset.get_by_label("Lit by").select_option("room")
    asset.locator("canvas.scene").press("ArrowLeft")
    # five degrees to the side; the address follows the camera a moment later
    asset.wait_for_function("() => Math.abs(Number(location.hash.match(/camera=([-.\\d]+)(,[-.\\d]+){5}(&|$)/)?.[1])) > 0.05")
    turned = shown(asset)
    asset.get_by_role("button", name="As it was captured").click()
    assert not np.array_equal(shown(asset), turned)
    asset.reload()
    asset.wait_for_function("() => globalThis.asset !== undefined", timeout=LOADED_MS)
