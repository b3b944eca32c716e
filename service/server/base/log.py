"""The log of the service: one event in a line, with its request and its job.

What anybody can cause is bounded: of warnings, errors and refused requests that repeat, REPEATS a minute are written, and then
their number.
Control characters are escaped, so that nobody who sends a request can forge a line or command the terminal of who reads the log.
"""

import io
import logging
import sys
import threading
import time
import warnings
from collections.abc import Hashable
from typing import TextIO

import structlog
from pydantic.warnings import UnsupportedFieldAttributeWarning

logger = structlog.stdlib.get_logger("relit")
REPEATS = 20
"""Lines that differ in their details only and are written within EVERY_S; the others are counted."""
EVERY_S = 60.0
MAX_KINDS = 1000
"""Kinds of lines that are told apart; beyond, lines of one event are of one kind, whoever caused them."""
REFUSED = (401, 429, 503)
"""Statuses that cost who asks for them nothing."""


def configure(level: str, form: str) -> None:
    """Log to standard error, from a level on and as json or text, the warnings of libraries too, but not that of FastAPI's bodies."""
    shared: list[structlog.typing.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    renderers: list[structlog.typing.Processor] = [structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
    if form == "text":
        renderers = [_escape, structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), exception_formatter=_traceback)]
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(structlog.stdlib.ProcessorFormatter(
        foreign_pre_chain=[*shared, structlog.stdlib.add_logger_name],
        processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *renderers]))
    handler.addFilter(Repeats())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)  # of libraries
    logging.captureWarnings(True)
    # FastAPI gives a body its parameter's name as an alias, and leaves this warning out only where the schema is built at once
    warnings.filterwarnings("ignore", "The 'alias' attribute", UnsupportedFieldAttributeWarning)
    logging.getLogger("relit").setLevel(level.upper())
    structlog.configure(processors=[*shared, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
                        logger_factory=structlog.stdlib.LoggerFactory(), wrapper_class=structlog.stdlib.BoundLogger,
                        cache_logger_on_first_use=True)


def adopt(library: str, *, without: tuple[type[BaseException], ...]) -> None:
    """Write what a library logs, which may have set up handlers of its own, as this log; leave out its reports of some exceptions."""
    theirs = logging.getLogger(library)
    theirs.handlers.clear()
    theirs.propagate = True
    theirs.addFilter(lambda record: not (record.exc_info and isinstance(record.exc_info[1], without)))


class Repeats(logging.Filter):
    """Lets REPEATS records of a kind through in EVERY_S, and then the number of the others."""

    def __init__(self) -> None:
        super().__init__()
        self._lock = threading.Lock()
        self._seen: dict[tuple[Hashable, ...], tuple[float, int]] = {}  # when the first record of a kind came, and how many since
        self._tell_at = 0.0

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a record is written."""
        kind, now = _kind(record), time.monotonic()
        self._tell(now)
        if kind is None:
            return True
        with self._lock:
            if kind not in self._seen and len(self._seen) >= MAX_KINDS:
                kind = kind[:2]
            began, count = self._seen.get(kind, (now, 0))
            self._seen[kind] = began, count + 1
        return count < REPEATS

    def _tell(self, now: float) -> None:
        """Write how many records of each kind were left out, once their time is over; at most once a second."""
        with self._lock:
            if now < self._tell_at:
                return
            self._tell_at = now + 1
            over = {kind: count - REPEATS for kind, (began, count) in self._seen.items() if now - began >= EVERY_S}
            for kind in over:
                del self._seen[kind]
        for kind, more in over.items():
            if more > 0:
                logger.warning("repeated", what=" ".join(map(str, kind)).strip(), more=more)


def _kind(record: logging.LogRecord) -> tuple[Hashable, ...] | None:
    """Return what records that repeat have in common; None: each is written."""
    if isinstance(record.msg, dict):  # of structlog
        event, error = record.msg.get("event"), record.msg.get("exc_info")
        if event == "request" and record.msg.get("status") in REFUSED:
            return event, record.msg["status"], record.msg.get("client")
        if event == "repeated":
            return None
    else:
        event, error = record.msg, record.exc_info[1] if record.exc_info else None
    return None if record.levelno < logging.WARNING else (record.name, str(event), "" if error is None else type(error).__name__)


def _escape(_logger: object, _method: str, event: structlog.typing.EventDict) -> structlog.typing.EventDict:
    return {_printable(name): _printable(value) if isinstance(value, str) else value for name, value in event.items()}


def _traceback(stream: TextIO, error: structlog.typing.ExcInfo) -> None:
    written = io.StringIO()
    structlog.dev.plain_traceback(written, error)
    stream.write("\n".join(_printable(line) for line in written.getvalue().split("\n")))


def _printable(text: str) -> str:
    return text if text.isprintable() else "".join(
        letter if letter.isprintable() else letter.encode("unicode_escape", "backslashreplace").decode() for letter in text)
