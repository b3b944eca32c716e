"""Frame numbers as text: ranges such as `7` and `1-24`, and file names with a run of # for the number."""

import re

from service.errors import RequestError

MAX_FRAMES = 100_000
"""The largest number of frames in one run, over an hour of film: more would fill the memory before the first frame."""


def frame_numbers(text: str | None, steps: int) -> list[int]:
    """Return the numbers of `7` or `1-24`; None: 1, or 1 to the number of steps.

    `steps` are the captures of the sequence, each of which gives one frame; 1 for a single capture, which gives any number.
    """
    first, last = _ends("--frames", text if text is not None else f"1-{steps}")
    count = last - first + 1
    if count > MAX_FRAMES:
        raise RequestError(f"--frames {text}: asks for {count} frames: {MAX_FRAMES} at most in one run")
    if steps > 1 and count != steps:
        raise RequestError(f"--frames {text}: asks for {count} frames, the sequence has {steps} captures: "
                           f"each gives one frame, such as {first}-{first + steps - 1}")
    return list(range(first, last + 1))


def part_of(numbers: list[int], text: str) -> range:
    """Return the numbers of a part, `7` or `1-24`, of a range of consecutive frames."""
    first, last = _ends("--only", text)
    if first < numbers[0] or last > numbers[-1]:
        raise RequestError(f"--only {text}: lies outside the frames {numbers[0]}-{numbers[-1]}")
    return range(first, last + 1)


def numbered(name: str, number: int) -> str:
    """Return the file name with its run of # replaced by the number, padded with zeros to the run's length."""
    return re.sub(r"#+", lambda run: f"{number:0{len(run[0])}d}", name)


def _ends(option: str, text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,18})(?:-(\d{1,18}))?", text.strip())
    if match is None:
        raise RequestError(f"{option} {text}: give a number, or first-last such as 1-24")
    first = int(match[1])
    last = int(match[2]) if match[2] is not None else first
    if last < first:
        raise RequestError(f"{option} {text}: runs backwards: give {last}-{first}")
    return first, last
