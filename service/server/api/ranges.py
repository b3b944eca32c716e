"""Conditions and parts of a download: entity tags (RFC 9110 section 13) and byte ranges (section 14)."""

import re
import secrets
from typing import NamedTuple

MAX_RANGES = 16
"""Of one request; one that asks for more gets the whole file."""
TAG = re.compile(r'(W/)?("[\x21\x23-\x7e\x80-\xff]*")')
RANGE = re.compile(r"\s*(?:([0-9]{1,18})-([0-9]{0,18})|-([0-9]{1,18}))\s*")


class Span(NamedTuple):
    """Bytes of a file."""

    start: int
    stop: int
    """The first that is not of it."""


def names(header: str, etag: str, *, strong: bool) -> bool:
    """Whether a list of entity tags has this one, or is *; strong: a weak tag is never the same."""
    return header.strip() == "*" or any(tag == etag and not (weak and strong) for weak, tag in TAG.findall(header))


def asked_for(header: str | None, size: int) -> list[Span] | None:
    """The parts of a file that a Range header asks for.

    Args:
        header: None: there is none.
        size: of the file.

    Returns:
        The parts that are there, in the order asked; none: the range lies outside. None: the whole file is asked for, or nothing that
        can be understood, which is the same (section 14.2).
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
    """The header that says which part it is."""
    return f"bytes {span.start}-{span.stop - 1}/{size}"


class Multipart(NamedTuple):
    """Several parts in one body (section 14.6)."""

    media_type: str
    pieces: list[bytes | Span]
    length: int


def multipart(spans: list[Span], size: int, media_type: str) -> Multipart:
    """Parts with what says which they are between them."""
    boundary = secrets.token_hex(16)
    pieces: list[bytes | Span] = []
    for span in spans:
        head = f"\r\n--{boundary}\r\nContent-Type: {media_type}\r\nContent-Range: {content_range(span, size)}\r\n\r\n"
        pieces += [head.encode(), span]
    pieces.append(f"\r\n--{boundary}--\r\n".encode())
    length = sum(piece.stop - piece.start if isinstance(piece, Span) else len(piece) for piece in pieces)
    return Multipart(f"multipart/byteranges; boundary={boundary}", pieces, length)
