"""Bodies that scatter light below their surface, farther in red than in blue, and opaque ones under soft and bounced light beside."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks.trials.lights import trial
from benchmarks.trials.trial import Trial
from service.requests.solve import Method
from tests.scenes.translucent import Body, write

SIDE, LIGHTS = 96, 32
CASES = {
    "waves, light runs 1 px below the surface": Body(lengths=(1.4, 1.0, 0.7)),
    "waves, light runs 3 px below the surface": Body(lengths=(4.2, 3.0, 2.1)),
    "waves, light runs 2 px below the surface, five times as far in red": Body(lengths=(5.0, 2.0, 1.0)),
    "waves, light runs 2 px below the surface in all colours": Body(lengths=(2.0, 2.0, 2.0)),
    "waves, opaque, soft lens, bounced light": Body(lens_px=0.7, bounced=(0.3, 0.2, 0.1)),
}


def trials(data: Path | None) -> Iterator[Trial]:
    """Yield every case, by both methods."""
    for number, (name, body) in enumerate(CASES.items()):
        for method in (Method.ROBUST, Method.SVBRDF):
            with tempfile.TemporaryDirectory() as folder:
                normal = write(Path(folder), body, side=SIDE, lights=LIGHTS, seed=700 + number)
                yield trial(name, Path(folder), normal, np.ones((SIDE, SIDE), dtype=bool), in_model=not any(body.lengths), method=method)[0]
