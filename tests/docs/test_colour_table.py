"""The colour spaces that pages convert between are those of the colour library."""

from importlib.resources import files

from docs.tools.colour_table import colour_table


def test_the_module_of_the_pages_is_the_newest():
    assert (files("service.server.pages") / "static" / "view" / "colour_table.js").read_text() == colour_table(), "run make colour-table"
