"""The page that lights published planes live: static files that need no server but one that serves files."""

import json
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from service.basis.capture import BasisCapture
from service.publish.annotations import Annotation
from service.requests.publish import PublishRequest
from stage.files import write_text

PAGE_FILE = "index.html"


def write_page(folder: Path, source: BasisCapture, request: PublishRequest, annotations: list[Annotation]) -> None:
    """Write the page beside planes."""
    title = request.title or source.capture.name
    for file in files("service.publish").joinpath("static").iterdir():
        text = file.read_text(encoding="utf-8")
        if file.name == PAGE_FILE:
            text = Template(text).substitute(title=escape(title), attribution=escape(request.attribution or ""))
        write_text(folder / file.name, text)
    notes: list[dict[str, Any]] = [note._asdict() for note in annotations]
    write_text(folder / "scene.json", json.dumps({"schema": "relit.scene/1", "title": title, "notes": notes}) + "\n")
