"""What `relit publish` of a large capture costs: seconds, peak memory, files and bytes of each kind of publication.

    python -m benchmarks.publishing FOLDER                    # 12 photographs of 50 megapixels: about 8 GB in the folder, removed again
    python -m benchmarks.publishing FOLDER --megapixels 4     # less of everything

The capture is that of `benchmarks.large`. Each kind has a process of its own, which reads the photographs anew.
"""

import argparse
import json
import math
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.large import ASPECT, make_capture, peak_gib
from service.publish.publish import publish
from service.requests.publish import PublishedAs, PublishRequest

PHOTOGRAPHS, MEGAPIXELS = 12, 50.0


def measure(folder: Path, kind: PublishedAs) -> dict[str, float]:
    """Publish the capture of a folder in this process, and return what it cost; what was made is removed."""
    out, begun = folder / "out", time.perf_counter()
    found = publish(PublishRequest(capture=folder / "capture", out=out, kind=kind, cache=folder / "cache",
                                   url="https://museum.org/large" if kind is PublishedAs.IIIF else None))
    seconds = time.perf_counter() - begun
    used = resource.getrusage(resource.RUSAGE_SELF)
    shutil.rmtree(out)
    shutil.rmtree(folder / "cache", ignore_errors=True)
    return {"seconds": seconds, "cpu_seconds": used.ru_utime + used.ru_stime, "peak_gib": peak_gib(), "files": found.files,
            "gb": found.size / 1e9}


def main() -> None:
    """Make the capture, publish it as each kind, and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--megapixels", type=float, default=MEGAPIXELS)
    parser.add_argument("--photographs", type=int, default=PHOTOGRAPHS)
    parser.add_argument("--as", dest="kinds", nargs="+", type=PublishedAs, default=list(PublishedAs))
    parser.add_argument("--measured", type=PublishedAs, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.measured is not None:
        print(json.dumps(measure(given.folder, given.measured)))
        return
    work = given.folder / "relit-publishing"
    height = round(math.sqrt(1e6 * given.megapixels / ASPECT))
    try:
        make_capture(work / "capture", round(1e6 * given.megapixels / height), height, given.photographs, "PIZ")
        print("| as | seconds | CPU seconds | peak, GiB | files | GB |\n|---|---:|---:|---:|---:|---:|")
        for kind in given.kinds:
            done = subprocess.run([sys.executable, "-m", "benchmarks.publishing", str(work), "--measured", kind], check=True,
                                  stdout=subprocess.PIPE, text=True)
            cost = json.loads(done.stdout)
            print(f"| `{kind}` | {cost['seconds']:.0f} | {cost['cpu_seconds']:.0f} | {cost['peak_gib']:.2f} | {cost['files']} | "
                  f"{cost['gb']:.2f} |", flush=True)
    finally:
        shutil.rmtree(work, ignore_errors=True)


if __name__ == "__main__":
    main()
