"""The part that most scans show, and the file of its design."""

from pathlib import Path

import pytest

from tests.scenes.machined_part import Part, machined_part, write_stl


@pytest.fixture(scope="module")
def part(tmp_path_factory) -> tuple[Part, Path]:
    made = machined_part()
    return made, write_stl(tmp_path_factory.mktemp("design") / "part.stl", made)
