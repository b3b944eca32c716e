"""Names that are markup are shown as text, whoever gave them: environments, results, frames, layers, units and methods."""


import pytest

from tests.service.server.pages.conftest import alter, await_whole, expect, seen

pytestmark = pytest.mark.long

HOSTILE = "<img src=x onerror=alert(1)>"
ENVIRONMENT = {"id": "env_0123456789abcdefghjk", "name": HOSTILE, "state": "ready", "registered": False, "problem": None, "facts": {},
               "view": None, "created_at": "2026-11-20T08:59:00Z"}


def changed(value, names: set[str]):
    """JSON with markup at the end of each text of these names."""
    if isinstance(value, list):
        return [changed(each, names) for each in value]
    if isinstance(value, dict):
        return {name: each + HOSTILE if name in names and isinstance(each, str) else changed(each, names)
                for name, each in value.items()}
    return value


@pytest.mark.parametrize(("place", "path", "names"), [
    ("job", "**/results", {"name"}), ("capture", "**/results/view.json", {"image", "label", "suspect", "name"}),
    ("light", "**/results/view.json", {"image", "label"}), ("maps", "**/results/view.json", {"title", "unit"}),
    ("light", "**/v1/environments*", None),
    ("home", "**/v1/environments*", None), ("captures", "**/v1/environments*", None), ("job", "**/results/report.json", {"method"})])
def test_a_name_that_is_markup_is_text(page, solved, place, path, names):
    asked = []

    def told(value):
        asked.append(path)
        return {**value, "items": [ENVIRONMENT]} if names is None else changed(value, names)

    page.on("dialog", lambda dialog: pytest.fail(dialog.message))
    alter(page, path, told)
    page.goto({"home": "/", "captures": "/captures", **solved.pages}[place])
    await_whole(page)
    if "report" not in path:
        page.wait_for_function("(text) => document.querySelector('main').textContent.includes(text)", arg=HOSTILE)
    seen(page, lambda: asked, "nothing is asked for")
    expect(page.locator("main img")).to_have_count(0)
