"""axe-core, the accessibility checker, which `make clients` installs."""

import os

import pytest

from benchmarks.clients import installed

REQUIRED = os.environ.get("RELIT_TEST_CLIENTS") == "required"

SERIOUS = ("serious", "critical")


def violations(page) -> list[str]:
    """What axe-core finds wrong with a page, of the impacts that count here: the rule, what it asks for, and where."""
    try:
        script = installed.node_modules() / "axe-core" / "axe.min.js"
    except installed.MissingClientError as error:
        (pytest.fail if REQUIRED else pytest.skip)(str(error))
    page.add_script_tag(path=script)
    found = page.evaluate("() => axe.run()")["violations"]
    return [f"{each['id']}: {each['help']}: {node['html']}" for each in found if each["impact"] in SERIOUS for node in each["nodes"]]
