"""How evenly relit play sends frames: their times of arrival on the loopback, against those that the rate gives.

python -m benchmarks.play_rate [--frames 200] [--universes 6]

The player is a process of its own, and this one receives, as fixtures do. A frame arrives when its synchronisation does.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from service.twin.listener import Listener
from tests.scenes.captures import ring
from tests.scenes.patched_rigs import loopback, write_cues_file, write_rig_file

RATES = (24, 40, 60)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--universes", type=int, default=6)
    given = parser.parse_args()
    print("\n".join(rate_table(given.frames, given.universes)))


def rate_table(frames: int, universes: int) -> list[str]:
    """Return the table of errors for each protocol and rate."""
    lines = ["| protocol | rate | frames received | step from frame to frame, median error | 95 % | largest |", "|---|---|---|---|---|---|"]
    for protocol in ("sacn", "artnet"):
        for rate in RATES:
            moments = arrivals(protocol, rate, frames, universes)
            error = 1e3 * np.abs(np.diff(moments) - 1 / rate)
            lines.append(f"| {protocol} | {rate} Hz | {len(moments)} of {frames} | {np.median(error):.2f} ms | "
                         f"{np.percentile(error, 95):.2f} ms | {error.max():.2f} ms |")
    return lines


def arrivals(protocol: str, rate: int, frames: int, universes: int) -> np.ndarray:
    """Play a show, and return the times in seconds at which its frames arrived."""
    host = loopback()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rig = write_rig_file(folder / "rig.json", ring(28 * universes), host=host, universes=universes, protocol=protocol)
        steps = np.repeat(1 + np.arange(frames)[:, None] % 255, 3 * 28 * universes, axis=1)
        cues = write_cues_file(folder / "cues.json", rig, steps)
        with Listener([(protocol, 1 + n) for n in range(universes)], host, keep=True) as listener:
            command = [sys.executable, "-m", "service.cli.main", "play", cues, rig, "--fps", str(rate)]
            subprocess.run(command, check=True, capture_output=True)
            time.sleep(0.2)
    return np.array([frame.time_s for frame in listener.kept if all(values.any() for values in frame.values.values())])


if __name__ == "__main__":
    main()
