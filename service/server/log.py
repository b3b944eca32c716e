"""The log of the service: one event in a line, with its request and its job."""

import logging
import sys

import structlog

logger = structlog.stdlib.get_logger("relit")


def configure(level: str, form: str) -> None:
    """Log to standard error, the warnings of libraries too.

    Args:
        level: debug, info, warning or error.
        form: json or text.
    """
    shared: list[structlog.typing.Processor] = [
        structlog.contextvars.merge_contextvars,
        structlog.stdlib.add_log_level,
        structlog.processors.TimeStamper(fmt="iso", utc=True),
    ]
    renderers: list[structlog.typing.Processor] = [structlog.dev.ConsoleRenderer(
        colors=sys.stderr.isatty(), exception_formatter=structlog.dev.plain_traceback)]
    if form == "json":
        renderers = [structlog.processors.format_exc_info, structlog.processors.JSONRenderer()]
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(structlog.stdlib.ProcessorFormatter(
        foreign_pre_chain=[*shared, structlog.stdlib.add_logger_name],
        processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *renderers]))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(logging.WARNING)  # of libraries
    logging.captureWarnings(True)
    logging.getLogger("relit").setLevel(level.upper())
    structlog.configure(processors=[*shared, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
                        logger_factory=structlog.stdlib.LoggerFactory(), wrapper_class=structlog.stdlib.BoundLogger,
                        cache_logger_on_first_use=True)


def adopt(library: str, *, without: type[BaseException]) -> None:
    """Write what a library logs, which may have set up handlers of its own, as this log; leave out its reports of one exception."""
    theirs = logging.getLogger(library)
    theirs.handlers.clear()
    theirs.propagate = True
    theirs.addFilter(lambda record: not (record.exc_info and isinstance(record.exc_info[1], without)))
