"""OpenLIME's own pictures of what relit publish --as openlime writes are Relit's."""

import pytest

from benchmarks.clients import installed
from service.publish.publish import publish
from service.requests.publish import PublishRequest
from tests.clients.openlime import opened
from tests.service.publish.published import SIZE, dome, levels_rms
from tests.service.server.pages import conftest as pages

pytestmark = pytest.mark.long
browser = pages.browser


@pytest.fixture(scope="module", autouse=True)
def package():
    """Skips the tests without it, in CI too: not every package registry has it."""
    try:
        installed.openlime()
    except installed.MissingClientError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    """The folder in which the dome is published; directions and pictures of its lights."""
    folder = tmp_path_factory.mktemp("openlime")
    lights, pictures = dome(folder / "dome")
    publish(PublishRequest(capture=folder / "dome", out=folder / "owl-planes", kind="openlime", cache=folder / "cache"))
    return folder, lights, pictures


@pytest.mark.parametrize(("layout", "scale", "tiles"), [
    ("image", 1, 1),
    ("deepzoom", 1, 5),  # two rows of two, and the whole image in one
    ("deepzoom", 0.5, 1),
])
def test_openlime_shows_a_hemisphere_of_lights_as_the_basis_has_it(browser, published, layout, scale, tiles):
    folder, lights, pictures = published
    side = int(scale * SIZE)
    smaller = pictures.reshape(len(lights), side, SIZE // side, side, SIZE // side, 3).mean(axis=(2, 4))
    with opened(browser, folder, layout, size=(SIZE, SIZE), scale=scale) as shown:
        assert shown.tiles == tiles
        assert levels_rms(shown.pictures(lights), smaller).max() < 2  # bytes, JPEG, and bytes again on the display
