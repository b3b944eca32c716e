"""CONTRIBUTING.md leads through the code as it is, and the pages of docs/ name modules that exist."""

import re

import pytest

from tests.test_architecture import HOME, imports_of, module_name

TEXT = (HOME / "CONTRIBUTING.md").read_text(encoding="utf-8")
WAYS = {title: re.findall(r"^\d\. `([^`]+)`( \(another process\))?", body, re.MULTILINE)
        for title, body in re.findall(r"^\*\*([^*]+)\*\*: .*\n\n((?:\d\. .*\n(?: {3}.*\n)*)+)", TEXT, re.MULTILINE)}
PATHS = [path.relative_to(HOME).as_posix() for folder in ("stage", "kernels", "service", "tests", "benchmarks", "samples", "docs")
         for path in (HOME / folder).rglob("*.py")]
MOST_FILES = 8
"""The most files of one way: a reader cannot keep more in view."""


def test_the_ways_are_read():
    assert list(WAYS) == ["Solve", "Relight with maps", "Depth", "Register and fuse", "A job of the service", "Export",
                          "A page of the browser"]


@pytest.mark.parametrize("way", WAYS)
def test_a_way_is_short_and_each_file_is_reached_from_one_before_it(way):
    files = WAYS[way]
    assert 2 < len(files) <= MOST_FILES
    numbers = re.findall(r"^(\d)\. ", TEXT.split(f"**{way}**: ")[1].split("\n**")[0].split("\n## ")[0], re.MULTILINE)
    assert numbers == [str(number + 1) for number in range(len(files))]
    reached: set[str] = set()
    for number, (file, another_process) in enumerate(files):
        assert (HOME / file).is_file(), file
        name = module_name(HOME / file)
        assert number == 0 or another_process or name in reached, f"{file} is imported by none of the files before it"
        reached |= {part for found in imports_of(HOME / file) for part in (found.target, found.target.rpartition(".")[0])}


@pytest.mark.parametrize("path", sorted(set(re.findall(r"`([a-z_]+/[a-z_/.]*)`", TEXT))))
def test_every_path_exists(path):
    """A folder of the service is named without service/ in the table of its folders."""
    assert (HOME / path).exists() or (HOME / "service" / path).exists()


@pytest.mark.parametrize("page", sorted((HOME / "docs").glob("*.md")), ids=lambda page: page.name)
def test_every_module_that_a_page_names_exists(page):
    """A page names a module by the end of its path."""
    named = set(re.findall(r"`([a-z_0-9/]+\.py)\b", page.read_text(encoding="utf-8")))
    assert [name for name in sorted(named) if not any(f"/{path}".endswith(f"/{name}") for path in PATHS)] == []
