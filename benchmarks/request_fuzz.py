"""Random requests against the whole API, with the figures of docs/service_security.md.

python -m benchmarks.request_fuzz [--cases 20000] [--state FILE] [--write docs/service_security.md]

schemathesis makes requests of the OpenAPI document, good, bad and in sequences (tests/service/server/api/fuzz.py), in rounds of a few
minutes against a new server each. A round passes if no answer breaks the document, none is 5xx, and the log has no traceback. With --state
the counts are kept in a file, and a later run goes on after them.
"""

import argparse
import json
import re
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.file_mutations import write_between
from service.server.base.settings import Settings
from tests.service.server.api import fuzz
from tests.service.server.api.test_openapi import NO_LIMITS
from tests.service.server_process import serving

START, END = "<!-- requests: made by benchmarks.request_fuzz -->", "<!-- end of requests -->"
PHASES = "fuzzing,stateful"
GENERATED = re.compile(r"(\d[\d,]*) generated")
"""How schemathesis ends: `Test cases: 1234 generated, 1234 passed`."""


def run_round(number: int, examples: int) -> tuple[int, list[str], dict[str, int]]:
    """Send the requests of one round; return how many they were, what is wrong, and how often each status was answered."""
    with tempfile.TemporaryDirectory(prefix="relit-fuzz-") as name:
        folder = Path(name)
        with serving(folder, "--device", "none", **NO_LIMITS) as server:
            key, known = fuzz.seed(Settings(data=server.data))
            fuzz.SEED = str(number)
            done = fuzz.fuzz(server, key, known, folder, examples=examples, phases=PHASES, max_time_s=None)
            log = server.log.read_text()
    faults = [] if done.returncode == 0 else [f"round {number}: {done.stdout[-3000:]}"]
    if "Traceback" in log or '"request failed"' in log:
        faults.append(f"round {number}: a traceback in the log: {log[log.index('Traceback') :][:3000] if 'Traceback' in log else ''}")
    statuses: dict[str, int] = {}
    for line in log.splitlines():
        if line.startswith("{") and (status := json.loads(line).get("status")) is not None:
            statuses[str(status)] = statuses.get(str(status), 0) + 1
    faults += [f"round {number}: {count} answers with status {status}" for status, count in statuses.items()
               if status >= "500" and status != "503"]
    found = GENERATED.findall(done.stdout)
    return int(found[-1].replace(",", "")) if found else sum(statuses.values()), faults, statuses


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=20_000)
    parser.add_argument("--examples", type=int, default=20, help="random requests of each operation in a round")
    parser.add_argument("--minutes", type=float, default=1e9, help="begin no further round after this time")
    parser.add_argument("--state", type=Path, help="the file with the counts so far")
    parser.add_argument("--write", type=Path, help="the document that the figures go into")
    chosen = parser.parse_args(arguments)
    state = {"rounds": 0, "cases": 0, "requests": 0, "faults": [], "statuses": {}}
    if chosen.state and chosen.state.exists():
        state = json.loads(chosen.state.read_text())
    until = time.monotonic() + 60 * chosen.minutes
    while state["cases"] < chosen.cases and time.monotonic() < until:
        cases, faults, statuses = run_round(state["rounds"], chosen.examples)
        state["rounds"] += 1
        state["cases"] += cases
        state["requests"] += sum(statuses.values())
        state["faults"] += faults
        for status, count in statuses.items():
            state["statuses"][status] = state["statuses"].get(status, 0) + count
        print(f"{state['cases']} cases, {state['requests']} requests, {len(state['faults'])} faults", flush=True)
        if chosen.state:
            chosen.state.write_text(json.dumps(state))
    print("\n".join(state["faults"]))
    if chosen.write:
        answered = ", ".join(f"{status}: {count}" for status, count in sorted(state["statuses"].items()))
        write_between(chosen.write, START, END, "\n".join([
            f"{state['cases']} cases in {state['rounds']} rounds, {state['requests']} requests; {len(state['faults'])} faults.",
            f"Answers by status: {answered}. Made by `python -m benchmarks.request_fuzz --write docs/service_security.md`."]))
    sys.exit(1 if state["faults"] else 0)


if __name__ == "__main__":
    main()
