"""The shipped owl on the twin of a stage with 96 lamps, whose pictures come into a watched folder."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import service
from stage.capture.capture import Capture
from tests.scenes.patched_rigs import loopback
from tests.scenes.rigs import write_rig
from tests.service.acquisition.test_acquire import posting
from tests.service.owl import OWL

ROOT = Path(service.__file__).parents[1]


@contextmanager
def owl_on_stage(folder: Path, *options: object) -> Iterator[list[object]]:
    """Run the twin, with options for it, as long as the block; yield the options of `relit capture` that name lamps, camera and --trigger.

    Its lamps are a third as bright as those of the owl's capture.
    """
    rig, watched, host = folder / "rig.json", folder / "watched", loopback()
    write_rig(rig, [frame.light.direction for frame in Capture.open(OWL).manifest.frames], {"white": (1.0, 1.0, 1.0)}, host=host)
    command = [sys.executable, "-m", "service.cli.main", "twin", rig, OWL, "--interface", host, "--port", "0", "--pictures", watched,
               "--noise", "0.001", "--exposure", "-2", "--cache", folder, *options]
    twin = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)})
    try:
        assert twin.stdout.readline().startswith("twin ")
        page = twin.stdout.readline().split()[1].removesuffix(":")
        yield ["--rig", rig, "--camera", f"watch:{watched}", "--trigger", posting(f"{page}/release")]
    finally:
        twin.kill()
        twin.wait()
