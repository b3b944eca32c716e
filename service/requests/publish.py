"""The options of `relit publish`."""

import re
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from service.requests.base.base import CAPTURE, Choice, Request, Role, Spelling, StackOptions
from stage.model import Line, NotNegativeCount

LICENCES = ("http://creativecommons.org/licenses/", "http://creativecommons.org/publicdomain/", "http://rightsstatements.org/vocab/")
"""How addresses of rights begin that IIIF Presentation 3 allows; it has no https there."""
ADDRESS = re.compile(r"https?://[^\s\"<>?#/]+(/[^\s\"<>?#]*)?")
"""An address with a host, and without a query or a fragment."""
DEFAULT_PHOTOGRAPHS = 8


class PublishedAs(Choice):
    """What a capture is published as."""

    IIIF = "iiif", "a manifest of IIIF Presentation 3 with image tiles of IIIF Image 3, level 0"
    OPENLIME = "openlime", "coefficient planes and the info.json that OpenLIME 1 and RelightLab read, whole and as Deep Zoom tiles"
    WEB = "web", "a page that lights the object live, with its tiles"


class PublishRequest(StackOptions, Request):
    """Publish a capture as a folder of static files, which any web server serves."""

    capture: Annotated[Path, Role.INPUT, CAPTURE]
    """Folder with a capture.json, or with what `relit solve` has made of one: with --as iiif its albedo and normals are shown too."""
    out: Annotated[Path, Role.OUTPUT, Spelling(flag="--to", metavar="DIR")]
    """Folder that is made, or one that this command has made before, which is replaced."""
    kind: Annotated[PublishedAs, Spelling(flag="--as")]
    """What is made of the capture."""
    maps: Annotated[Path | None, Role.INPUT, Spelling(metavar="DIR")] = None
    """iiif: folder with the maps.exr of the capture, whose albedo and normals are shown too."""
    annotations: Annotated[Path | None, Role.INPUT] = None
    """iiif and web: Web Annotations (W3C) as JSON: an AnnotationPage, or a list. Points and rectangles in pixels of the image,
    with `crop` of its part, with a text."""
    title: Line | None = None
    """iiif and web: title of the object; None: the name of the capture."""
    attribution: Line | None = None
    """iiif and web: words that must stand beside the pictures, as of who owns them."""
    url: Line | None = None
    """iiif: address under which the folder will be served, as in https://museum.org/owl; a manifest needs whole addresses."""
    rights: Line | None = None
    """iiif: address of a licence of creativecommons.org or of a statement of rightsstatements.org."""
    photographs: NotNegativeCount | None = None
    """iiif: most photographs, spread over the lights in their order; None: 8."""
    quality: Annotated[int, Field(ge=1, le=100)] = 98
    """Quality of the JPEG files; of planes, the first of which count most and are kept at up to 100, that of the last."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name in ("maps", "url", "rights", "photographs"):
            if getattr(self, name) is not None and self.kind is not PublishedAs.IIIF:
                raise ValueError(f"--{name} is for --as iiif, not for --as {self.kind}")
        for name in ("annotations", "attribution", "title"):
            if getattr(self, name) is not None and self.kind is PublishedAs.OPENLIME:
                raise ValueError(f"--{name} is for --as iiif and --as web, not for --as openlime, whose files have no place for it")
        if self.kind is PublishedAs.IIIF:
            if self.url is None:
                raise ValueError("--url is missing: a manifest of IIIF names its files by whole addresses: give that of the folder, as in "
                                 "https://museum.org/owl")
            if ADDRESS.fullmatch(self.url) is None:
                raise ValueError(f"--url is {self.url}: give an address of a folder that begins with http:// or https://, as in "
                                 "https://museum.org/owl")
            rights = (self.rights or LICENCES[0]).replace("https://", "http://")
            if not rights.startswith(LICENCES) or ADDRESS.fullmatch(rights) is None:
                raise ValueError(f"--rights is {self.rights}: IIIF takes addresses that begin with {' or '.join(LICENCES)}")
        return self
