"""Damaged files of every kind that relit reads, against its readers: the table of files in docs/service_security.md.

python -m benchmarks.file_mutations [--cases 50000] [--state FILE] [--write docs/service_security.md]

Case n damages one sound file in a way that n alone decides. It is read in a process with 2 GiB of memory; a case passes if the file is
read, or refused with one sentence that names it. A process that dies, or is silent for five minutes, is a fault of its case. With --state
the counts are kept in a file, and a later run goes on after them. Exits with 1 after a fault, which --case N repeats in this process.
"""

import argparse
import copy
import json
import os
import random
import resource
import select
import struct
import subprocess
import sys
import tempfile
import zlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from benchmarks.mutated_files import Kind, kinds
from service.errors import USER_ERRORS, sentence

MEMORY_BYTES = 2 << 30
SILENT_S = 300.0
LONG_LIST = 5000
"""Entries of a list that is not made longer."""
READ, REFUSED, FAULT = "read", "refused", "fault"
NUMBERS = (0, 1, 2, 127, 128, 255, 256, 32767, 32768, 65535, 65536, 2**31 - 1, 2**31, 2**32 - 1)
VALUES = (None, True, -1, 0, 1e308, -1e-320, 2**63, 10**400, "", " ", "a\0b", "\ud800", "\x1b[2J", "x" * 5000, "../../a", "/etc/passwd",
          "con", [], {}, [[]], [0] * 2000, {"a": {"b": 1}}, "[" * 2000)
START, END = "<!-- files: made by benchmarks.file_mutations -->", "<!-- end of files -->"


def damage(sound: bytes, kind: Kind, number: int) -> bytes:
    """Return the damaged content of a case."""
    chance = random.Random(number)
    if kind.text and chance.random() < 0.7 and kind.path.suffix == ".json" and not sound.startswith(b"%"):
        return _other_value(sound, chance)
    content = bytearray(sound)
    for _ in range(chance.choice((1, 1, 1, 2, 4, 16, 64))):
        if not content:
            break
        at = min(chance.randrange(len(content)), chance.choice((len(content), 400)) - 1)  # headers more often
        length = min(chance.choice((1, 2, 4, 16, 200)), len(content) - at)
        match chance.randrange(8):
            case 0:
                content[at] ^= 1 << chance.randrange(8)
            case 1:
                content[at] = chance.randrange(256)
            case 2:
                del content[at : at + length]
            case 3:
                content[at:at] = content[at : at + length] * chance.choice((1, 2, 50))
            case 4:
                content[at : at + 4] = struct.pack(chance.choice("<>") + "I", chance.choice(NUMBERS))
            case 5:
                content[at : at + 2] = struct.pack(chance.choice("<>") + "H", chance.choice(NUMBERS) & 0xFFFF)
            case 6:
                del content[at:]
            case _:
                other = chance.randrange(len(content))
                content[at : at + length] = content[other : other + length]
    if sound.startswith(b"\x89PNG") and chance.random() < 0.7:
        return _with_checksums(bytes(content))
    return bytes(content)


def _other_value(sound: bytes, chance: random.Random) -> bytes:
    """Return JSON in which some values are others, keys are missing, or lists are longer."""
    data = json.loads(sound)
    for _ in range(chance.choice((1, 1, 2, 5))):
        places = list(_places(data))
        if not places:
            break
        holder, key = chance.choice(places)
        match chance.randrange(4):
            case 0:
                del holder[key]
            case 1 if isinstance(holder, dict):
                holder[chance.choice(("x", "\0", "\ud800", "schema", "name"))] = holder[key]
            case 2 if isinstance(holder, list) and len(holder) < LONG_LIST:
                holder += copy.deepcopy(holder) * chance.choice((1, 20))
            case _:
                holder[key] = copy.deepcopy(chance.choice(VALUES))
    return json.dumps(data).encode()


def _places(data: object):
    """Yield every container of JSON with each of its keys."""
    if isinstance(data, dict | list):
        for key in data if isinstance(data, dict) else range(len(data)):
            yield data, key
            yield from _places(data[key])


def _with_checksums(content: bytes) -> bytes:
    """Return a PNG whose chunks have the checksums of their content, so that the decoder sees it."""
    made, at = bytearray(content[:8]), 8
    while at + 12 <= len(content):
        length = min(int.from_bytes(content[at : at + 4], "big"), len(content) - at - 12)
        body = content[at + 4 : at + 8 + length]
        made += length.to_bytes(4, "big") + body + struct.pack(">I", zlib.crc32(body))
        at += 12 + length
    return bytes(made)


def run(kind: Kind, number: int) -> str:
    """Do one case, and return READ, REFUSED, or FAULT with what is wrong."""
    sound = kind.path.read_bytes()
    kind.path.write_bytes(damage(sound, kind, number))
    try:
        kind.read(kind.path)
        return READ
    except USER_ERRORS as error:
        told = sentence(error)
        named = str(kind.path.parent) in told or kind.path.suffix == ".toml"  # or a file that it names
        return REFUSED if named and told.isprintable() and len(told) < 4000 else f"{FAULT}: the sentence is {told[:300]}"
    except BaseException as error:
        return f"{FAULT}: {type(error).__name__}: {str(error)[:300]}"
    finally:
        kind.path.write_bytes(sound)


def work(first: int, last: int) -> None:
    """Do the cases of a range in this process, and print each with its outcome."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # libraries print there what they find wrong
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
    with tempfile.TemporaryDirectory(prefix="relit-mutations-") as folder:
        known = kinds(Path(folder) / "files")
        for number in range(first, last):
            print(json.dumps({"begun": number}), file=answers, flush=True)
            kind = known[number % len(known)]
            outcome = run(kind, number)
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            print(json.dumps({"case": number, "kind": kind.name, "outcome": outcome, "peak_kb": peak}), file=answers, flush=True)


def supervise(first: int, last: int, counts: Counter[str], faults: list[str]) -> tuple[int, int]:
    """Let a process do cases; return the next case and the most memory that the process had, KiB."""
    process = subprocess.Popen([sys.executable, "-m", __spec__.name if __spec__ else __name__, "--work", str(first), str(last)],
                               stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, preexec_fn=lambda: os.nice(10))
    assert process.stdout is not None
    begun, following, peak, rest = first, first, 0, b""
    try:
        while True:
            if not select.select([process.stdout], [], [], SILENT_S)[0]:
                faults.append(f"case {begun}: no answer for {SILENT_S:g} s")
                counts["fault"] += 1
                return begun + 1, peak
            block = os.read(process.stdout.fileno(), 1 << 16)
            if not block:
                break
            *lines, rest = (rest + block).split(b"\n")
            for line in lines:
                found = json.loads(line)
                if "begun" in found:
                    begun = found["begun"]
                    continue
                outcome = found["outcome"].partition(":")[0]
                counts[f"{found['kind']}|{outcome}"] += 1
                peak, following = found["peak_kb"], found["case"] + 1
                if outcome == FAULT:
                    faults.append(f"case {found['case']} ({found['kind']}): {found['outcome']}")
    finally:
        process.kill()
        process.wait()
    if following < last:
        faults.append(f"case {begun}: the process ended ({process.returncode})")
        counts["fault"] += 1
        return begun + 1, peak
    return last, peak


def table(counts: Counter[str], done: int, peak_kb: int, faults: Sequence[str]) -> str:
    names = list(dict.fromkeys(name.rpartition("|")[0] for name in counts if "|" in name))
    rows = [f"| {name} | {sum(counts[f'{name}|{outcome}'] for outcome in (READ, REFUSED, FAULT))} | {counts[f'{name}|{READ}']} | "
            f"{counts[f'{name}|{REFUSED}']} | {counts[f'{name}|{FAULT}']} |" for name in sorted(names)]
    return "\n".join([
        f"{done} damaged files; the largest process had {peak_kb / 1024:.0f} MiB; {len(faults)} faults. Made by",
        "`python -m benchmarks.file_mutations --write docs/service_security.md`.", "",
        "| file | cases | read all the same | refused by name | faults |", "|---|---|---|---|---|", *rows])


def write_between(document: Path | None, start: str, end: str, text: str) -> None:
    """Replace what stands between two lines of a document, or print the text where there is none."""
    if document is None:
        print(text)
        return
    before, mark, rest = document.read_text().partition(f"{start}\n")
    if not mark or end not in rest:
        sys.exit(f"{document} lacks the lines {start} and {end}")
    document.write_text(f"{before}{start}\n{text}\n{rest[rest.index(end) :]}")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=50_000)
    parser.add_argument("--state", type=Path, help="the file with the counts so far")
    parser.add_argument("--write", type=Path, help="the document that the table goes into")
    parser.add_argument("--batch", type=int, default=1000, help="cases of a process")
    parser.add_argument("--case", type=int, help="do this case here, and show its error")
    parser.add_argument("--work", type=int, nargs=2, help=argparse.SUPPRESS)
    chosen = parser.parse_args(arguments)
    if chosen.work:
        return work(*chosen.work)
    if chosen.case is not None:
        with tempfile.TemporaryDirectory() as folder:
            known = kinds(Path(folder) / "files")
            kind = known[chosen.case % len(known)]
            kind.path.write_bytes(damage(kind.path.read_bytes(), kind, chosen.case))
            print(kind.name, repr(kind.path.read_bytes()[:2000]))
            kind.read(kind.path)
        return None
    state = {"next": 0, "counts": {}, "peak_kb": 0, "faults": []}
    if chosen.state and chosen.state.exists():
        state = json.loads(chosen.state.read_text())
    counts: Counter[str] = Counter(state["counts"])
    done, peak, faults = state["next"], state["peak_kb"], state["faults"]
    while done < chosen.cases:
        done, had = supervise(done, min(chosen.cases, done + chosen.batch), counts, faults)
        peak = max(peak, had)
        print(f"{done} cases, {len(faults)} faults, {peak / 1024:.0f} MiB", flush=True)
        if chosen.state:
            chosen.state.write_text(json.dumps({"next": done, "counts": counts, "peak_kb": peak, "faults": faults}))
    for fault in faults:
        print(fault)
    if chosen.write:
        write_between(chosen.write, START, END, table(counts, done, peak, faults))
    sys.exit(1 if faults else 0)


if __name__ == "__main__":
    main()
