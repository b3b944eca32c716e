"""Web Annotations (W3C) of an image: points and rectangles in its pixels, with a text."""

import json
import re
from pathlib import Path
from typing import Any, NamedTuple

from stage.errors import ManifestError, storage

FARTHEST = 1e6
"""No image has so many pixels in a row."""
NUMBER = r"(\d+(?:\.\d+)?)"
RECTANGLE = re.compile(rf"(?:.*#)?xywh=(?:pixel:)?{NUMBER},{NUMBER},{NUMBER},{NUMBER}")


class Annotation(NamedTuple):
    """A text about a part of the image."""

    x: float
    y: float
    width: float
    """0 with the height: a point."""
    height: float
    text: str


def read_annotations(path: Path | None, width: int, height: int) -> list[Annotation]:
    """Return the annotations of a file, an AnnotationPage or a list, for an image of this size; none without a file.

    Raises:
        ManifestError: it is no such file, or an annotation has no text, or a place that is none of the image; names it by its number.
    """
    if path is None:
        return []
    with storage("read", path):
        content = path.read_bytes()
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ManifestError(f"{path}: is no JSON: {error}") from error
    items = found.get("items") if isinstance(found, dict) else found
    if not isinstance(items, list):
        raise ManifestError(f"{path}: is no list of annotations, nor an AnnotationPage with items")
    return [_read(f"{path}: annotation {number}", item, width, height) for number, item in enumerate(items, start=1)]


def _read(where: str, item: Any, width: int, height: int) -> Annotation:
    bodies = _list(item.get("body")) if isinstance(item, dict) else []
    values = [body.get("value") if isinstance(body, dict) else body for body in bodies]
    text = " ".join(value for value in values if isinstance(value, str)).strip()
    if not text:
        raise ManifestError(f"{where}: has no text: give it a body with a value")
    place = next(filter(None, map(_place, _list(item.get("target")))), None)
    if place is None:
        raise ManifestError(f"{where}: has no place: give its target a PointSelector, or a FragmentSelector with "
                            "xywh=x,y,width,height in pixels")
    x, y, across, down = place
    if x + across > width or y + down > height:
        raise ManifestError(f"{where}: lies outside the image, which has {width}x{height} pixels")
    return Annotation(x, y, across, down, text)


def _place(target: Any) -> tuple[float, float, float, float] | None:
    """Return x, y, width and height of a target, in pixels; None: it has no place that is known here."""
    for selector in _list(target.get("selector")) if isinstance(target, dict) else [{"value": target}]:
        if isinstance(selector, dict) and selector.get("type") == "PointSelector":
            x, y = _number(selector.get("x")), _number(selector.get("y"))
            if x is not None and y is not None:
                return x, y, 0.0, 0.0
        elif isinstance(selector, dict) and (match := RECTANGLE.fullmatch(str(selector.get("value")))) is not None:
            x, y, width, height = map(float, match.groups())
            return x, y, width, height
    return None


def _number(value: Any) -> float | None:
    """Return a place along a row or a column, or None for what is none."""
    return float(value) if type(value) in (int, float) and 0 <= value < FARTHEST else None


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [] if value is None else [value]
