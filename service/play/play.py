"""Send a show frame by frame at its rate, and leave the lamps dark however it ends."""

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import chain, repeat
from typing import NamedTuple

from service.errors import RequestError
from service.play.outputs import Output, open_output
from service.play.show import Show, Values, read_show
from service.requests.play import PlayRequest

LATE_S = 0.001
"""A frame that has left more than this after its time is late."""
READY_S = 0.01
"""A frame is prepared so long before its time."""
KEEP_ALIVE_S = 0.8
"""The longest silence; E1.31-2018, section 6.6.2, asks for a packet between 800 and 1000 ms after the last one."""
REPEATS, REPEAT_S = 2, 0.025
"""How often values that stay are sent again before silences, as packets may be lost (the same section asks for three packets), and the time
between: DMX has 44 refreshes a second."""
BLACKOUTS, BLACKOUT_PAUSE_S = 3, 0.02
"""The dark frames at the end, because any packet may be lost, and the time between them."""
SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")
"""The signals that end a show; the last comes when the terminal is closed, and Windows lacks it."""


class PlayResult(NamedTuple):
    """A summary of what was sent."""

    frames: int
    """Number of frames that were sent, without the dark ones."""
    late: int
    """Number of frames that left more than LATE_S after their time."""
    latest_s: float
    """The most by which a frame was late."""
    interrupted: bool
    """True if a signal ended the show before its last frame."""


def play(request: PlayRequest, stop: threading.Event | None = None) -> PlayResult:
    """Play cues on a rig.

    The show ends with its last frame, or when `stop` is set or the program gets one of SIGNALS. In each case, and after an error, dark
    frames are sent and the streams are terminated. `stop`: ends the show from another thread. Raises RequestError if an option cannot be
    used, a package is missing, or the network refuses. Raises StageError if the cues or the rig are wrong, or do not fit each other; names
    file and field."""
    return run(prepare(request), stop)


class Prepared(NamedTuple):
    """A show that is checked, and the outputs that send it."""

    show: Show
    outputs: dict[str, Output]


def prepare(request: PlayRequest) -> Prepared:
    """Read the cues and the rig of a request and open its outputs; nothing is sent yet. Raises as `play` does."""
    show = read_show(request)
    return Prepared(show, {protocol: open_output(protocol, hosts, request) for protocol, hosts in show.hosts.items()})


def run(prepared: Prepared, stop: threading.Event | None = None) -> PlayResult:
    """Send a show that is prepared, and leave the lamps dark, as `play` does."""
    show, outputs = prepared
    with ended_by_signals(stop or threading.Event()) as stopping:
        send(outputs, show.dark)  # now fixtures wait for the synchronisation, so that none shows a part of the first frame
        try:
            return _run(show, outputs, stopping)
        finally:
            black_out(outputs, show.dark)


def _run(show: Show, outputs: dict[str, Output], stopping: threading.Event) -> PlayResult:
    """Send every frame at its time; the times are counted from the first frame, so that no delay adds up."""
    period = 1 / show.frames_per_second
    start = time.monotonic() + period
    sent, late, latest = 0, 0, 0.0
    for position in show.order:
        due = start + sent * period
        if _wait(due - min(READY_S, period / 2), outputs, stopping):
            break
        for protocol, output in outputs.items():
            output.set(show.frames[position][protocol])
        if stopping.wait(max(0.0, due - time.monotonic())):
            break
        for output in outputs.values():
            output.send()
        lateness = time.monotonic() - due
        sent, late, latest = sent + 1, late + (lateness > LATE_S), max(latest, lateness)
    _wait(start + sent * period, outputs, stopping)  # the last frame has its time too
    return PlayResult(sent, late, latest, stopping.is_set())


def _wait(until: float, outputs: dict[str, Output], stopping: threading.Event) -> bool:
    """Wait for a moment of the monotonic clock, and return True if the show is stopped before.

    The last frame is sent again REPEATS times if it stays, then every KEEP_ALIVE_S, because fixtures take a silent source for lost.
    """
    pauses = chain(repeat(REPEAT_S, REPEATS), repeat(KEEP_ALIVE_S))
    while (left := max(0.0, until - time.monotonic())) > 2 * REPEAT_S and (pause := next(pauses)) < left:  # not just before the next frame
        if stopping.wait(pause):
            return True
        for output in outputs.values():
            output.send()
    return stopping.wait(left)


def send(outputs: dict[str, Output], values: Values) -> None:
    """Send a frame with the output of each protocol."""
    for protocol, output in outputs.items():
        output.set(values[protocol])
        output.send()


def black_out(outputs: dict[str, Output], dark: Values) -> None:
    """Send dark frames with every output, also when another one fails, and end them."""
    refused: RequestError | None = None
    for _ in range(BLACKOUTS):
        for protocol, output in outputs.items():
            try:
                send({protocol: output}, dark)
            except RequestError as error:
                refused = error
        time.sleep(BLACKOUT_PAUSE_S)
    for output in outputs.values():
        with suppress(RequestError):
            output.end()
    if refused is not None:
        raise RequestError(f"the lamps may still be lit: {refused}") from refused


@contextmanager
def ended_by_signals(stopping: threading.Event) -> Iterator[threading.Event]:
    """Set an event at a signal, in place of an exception that could come between two universes or while the lamps are turned dark."""
    caught = [number for name in SIGNALS if (number := getattr(signal, name, None)) and signal.getsignal(number) is not signal.SIG_IGN]
    if threading.current_thread() is not threading.main_thread():  # only there signals can be caught
        caught = []
    before = {number: signal.signal(number, lambda *_: stopping.set()) for number in caught}
    try:
        yield stopping
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
