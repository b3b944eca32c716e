"""Annotations of captures: read, added and deleted."""

from service.client.connection import Connection
from service.requests.base.annotations import AnnotationPage, AnnotationView


class Annotations:
    """The annotations of the captures of a project."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def page(self, capture: str) -> AnnotationPage:
        """Return the annotations of a capture; `model_dump_json(by_alias=True)` of it is a file for `relit publish --annotations`."""
        return self._connection.ask(AnnotationPage, "GET", self._at(capture))

    def add(self, capture: str, text: str, x: float, y: float, width: float = 0.0, height: float = 0.0) -> AnnotationView:
        """Add a text about a rectangle of the image, in pixels from its upper left corner; without a size about a point."""
        selector = ({"type": "FragmentSelector", "value": f"xywh={x:g},{y:g},{width:g},{height:g}"} if width or height else
                    {"type": "PointSelector", "x": x, "y": y})
        body = {"body": {"type": "TextualBody", "value": text}, "target": {"selector": selector}}
        return self._connection.ask(AnnotationView, "POST", self._at(capture), json=body, repeatable=False)

    def delete(self, annotation: AnnotationView) -> None:
        """Delete an annotation."""
        self._connection.send("DELETE", annotation.id, repeatable=False)

    def _at(self, capture: str) -> str:
        return self._connection.path("/v1/captures", capture, "annotations")
