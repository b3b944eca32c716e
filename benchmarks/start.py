"""How long `relit --help` takes: `python -m benchmarks.start`. The goal is 0.4 s on a quiet machine."""

import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

HOME = Path(__file__).resolve().parents[1]
RUNS = 15
ENVIRONMENT = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
"""The environment of the commands: Python keeps the bytecode of modules, as it does for users; some containers turn that off."""
COMMANDS = {"python -c pass": ["-c", "pass"], "relit --help": ["-m", "service.cli.main", "--help"]}


def seconds(arguments: list[str]) -> float:
    began = time.perf_counter()
    subprocess.run([sys.executable, *arguments], cwd=HOME, env=ENVIRONMENT, stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - began


def main() -> None:
    """Time the commands in turn, so that a busy machine slows both, and print medians."""
    for arguments in COMMANDS.values():
        seconds(arguments)  # keeps the bytecode
    taken: dict[str, list[float]] = {name: [] for name in COMMANDS}
    for _ in range(RUNS):
        for name, arguments in COMMANDS.items():
            taken[name].append(seconds(arguments))
    for name, each in taken.items():
        print(f"{name:<16} {statistics.median(each):.3f} s, best {min(each):.3f} s")


if __name__ == "__main__":
    main()
