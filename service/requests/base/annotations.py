"""Web Annotations (W3C) of an object: a text about a point or a rectangle of its photographs, as the API takes and returns them."""

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Place = Annotated[float, Field(ge=0, lt=1e6, allow_inf_nan=False)]
NUMBER = r"\d{1,6}(?:\.\d{1,6})?"
CONTEXT = "http://www.w3.org/ns/anno.jsonld"


class _Part(BaseModel):
    model_config = ConfigDict(use_attribute_docstrings=True, extra="forbid")


class TextualBody(_Part):
    """The text of an annotation."""

    type: Literal["TextualBody"]
    value: Annotated[str, Field(min_length=1, max_length=2000, pattern=r"\S")]


class PointSelector(_Part):
    """A point of the image, in pixels from its upper left corner."""

    type: Literal["PointSelector"]
    x: Place
    y: Place


class FragmentSelector(_Part):
    """A rectangle of the image."""

    type: Literal["FragmentSelector"]
    value: Annotated[str, Field(pattern=rf"^xywh=(?:pixel:)?{NUMBER},{NUMBER},{NUMBER},{NUMBER}$", examples=["xywh=10,20,64,48"])]
    """xywh=x,y,width,height in pixels."""


class Target(_Part):
    """The subject of an annotation."""

    selector: Annotated[PointSelector | FragmentSelector, Field(discriminator="type")]


class NewAnnotation(_Part):
    """An annotation to keep with an object."""

    type: Literal["Annotation"] = "Annotation"
    body: TextualBody
    target: Target

    def box(self) -> tuple[float, float, float, float]:
        """Return x, y, width and height in pixels; width and height of a point are 0."""
        selector = self.target.selector
        if isinstance(selector, PointSelector):
            return selector.x, selector.y, 0.0, 0.0
        x, y, width, height = map(float, selector.value.rpartition(":")[2].removeprefix("xywh=").split(","))
        return x, y, width, height


class AnnotationView(NewAnnotation):
    """An annotation that is kept."""

    id: str
    """Its address on this server, at which it can be deleted."""
    created: datetime
    """UTC."""


class AnnotationPage(BaseModel):
    """The annotations of an object, the oldest first: a file that `relit publish --annotations` takes."""

    model_config = ConfigDict(populate_by_name=True)

    context: Annotated[str, Field(alias="@context")] = CONTEXT
    type: Literal["AnnotationPage"] = "AnnotationPage"
    items: list[AnnotationView]


def page_of(capture: str, rows: list[Any]) -> AnnotationPage:
    """Return the page of the rows of a capture."""
    return AnnotationPage(items=[view_of(capture, row) for row in rows])


def view_of(capture: str, row: Any) -> AnnotationView:
    """Return the view of a row."""
    address = f"/v1/captures/{capture}/annotations/{row['id']}"
    return AnnotationView.model_validate({**row["content"], "id": address, "created": row["created_at"]})
