"""The extension in Blender, for tests that are skipped where Blender is not installed."""

from pathlib import Path

from benchmarks.clients import panel
from benchmarks.clients.render import Client
from tests.clients.programs import require


def in_blender(script: str, folder: Path, **values: object) -> dict:
    """Return what a script found, as benchmarks.clients.panel runs it."""
    require(Client.BLENDER)
    return panel.in_blender(script, folder, **values)
