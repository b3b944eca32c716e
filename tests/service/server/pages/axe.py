"""axe-core, the accessibility checker, which `make clients` installs."""

import os

import pytest

from benchmarks.clients import installed

REQUIRED = os.environ.get("RELIT_TEST_CLIENTS") == "required"

COLOURS = {"runOnly": ["cat.color"]}
"""Rules that look at colours, which are all that the dark scheme of base.css changes."""


def violations(page, options: dict | None = None) -> list[str]:
    """What axe-core finds wrong with a page: the rule, what it asks for, and where."""
    try:
        script = installed.node_modules() / "axe-core" / "axe.min.js"
    except installed.MissingClientError as error:
        (pytest.fail if REQUIRED else pytest.skip)(str(error))
    if page.evaluate("() => globalThis.axe === undefined"):
        page.add_script_tag(path=script)
    found = page.evaluate("(options) => axe.run(options)", options or {})["violations"]
    return [f"{each['id']}: {each['help']}: {node['html']}" for each in found for node in each["nodes"]]


def assert_accessible(page, *widths: int) -> None:
    """All is within the width of each of these windows, and axe finds nothing in the light scheme, nor with the colours of the dark one."""
    assert_fits(page, *widths)
    page.emulate_media(color_scheme="light")
    found = violations(page)
    page.emulate_media(color_scheme="dark")
    assert found + violations(page, COLOURS) == []


def assert_fits(page, *widths: int) -> None:
    """All is within the width: 390 px is a telephone, 640 px a screen of 1280 px at 200 %."""
    for width in widths:
        page.set_viewport_size({"width": width, "height": 844})
        page.wait_for_function("(width) => document.documentElement.scrollWidth <= width", arg=width)
