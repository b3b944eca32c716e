"""Preconditions and ranges of a download: entity tags (RFC 9110 section 13) and byte ranges (section 14)."""

import re
import secrets
from typing import NamedTuple

MAX_RANGES = 16
"""Ranges of one request; a request for more gets the whole file."""
TAG = re.compile(r'(W/)?("[\x21\x23-\x7e\x80-\xff]*")')
RANGE = re.compile(r"\s*(?:([0-9]{1,18})-([0-9]{0,18})|-([0-9]{1,18}))\s*")


class Span(NamedTuple):
    """A range of bytes of a file."""

    start: int
    stop: int
    """The first byte after the range."""


def names(header: str, etag: str, *, strong: bool) -> bool:
    """Return whether a list of entity tags contains `etag` or is *; with `strong`, weak tags do not count."""
    return header.strip() == "*" or any(tag == etag and not (weak and strong) for weak, tag in TAG.findall(header))


def asked_for(header: str | None, size: int) -> list[Span] | None:
    """Return the ranges of a file that a Range header asks for.

    Args:
        header: the header; None: the request has none.
        size: of the file, bytes.

    Returns:
        The ranges within the file, in the order of the header; an empty list if all lie outside. None: the header asks for the whole
        file or cannot be read, which is the same (section 14.2).
    """
    unit, _, text = (header or "").partition("=")
    parts = [RANGE.fullmatch(part) for part in text.split(",")]
    if unit.strip().lower() != "bytes" or len(parts) > MAX_RANGES:
        return None
    spans = []
    for part in parts:
        if part is None:
            return None
        first, last, suffix = part.groups()
        span = Span(max(0, size - int(suffix)), size) if suffix else Span(int(first), min(size, int(last) + 1 if last else size))
        if last and int(last) < int(first):
            return None
        if span.start < span.stop:
            spans.append(span)
    return spans


def content_range(span: Span, size: int) -> str:
    """Return the Content-Range header of a range."""
    return f"bytes {span.start}-{span.stop - 1}/{size}"


class Multipart(NamedTuple):
    """A body with several ranges (section 14.6)."""

    media_type: str
    pieces: list[bytes | Span]
    length: int


def multipart(spans: list[Span], size: int, media_type: str) -> Multipart:
    """Return the body of several ranges, each with its headers."""
    boundary = secrets.token_hex(16)
    pieces: list[bytes | Span] = []
    for span in spans:
        head = f"\r\n--{boundary}\r\nContent-Type: {media_type}\r\nContent-Range: {content_range(span, size)}\r\n\r\n"
        pieces += [head.encode(), span]
    pieces.append(f"\r\n--{boundary}--\r\n".encode())
    length = sum(piece.stop - piece.start if isinstance(piece, Span) else len(piece) for piece in pieces)
    return Multipart(f"multipart/byteranges; boundary={boundary}", pieces, length)
