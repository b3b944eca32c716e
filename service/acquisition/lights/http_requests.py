"""Lamps of a controller that takes an HTTP request for each change."""

import urllib.error
import urllib.request
from http.client import HTTPException
from pathlib import Path
from urllib.parse import quote

from service.acquisition.lights.lights import Ask
from service.acquisition.lights.switched import SwitchedLamps
from service.errors import RequestError
from stage.rig.controllers import HttpController, HttpRequest
from stage.rig.rig import Rig

SEPARATOR = "\0"
URL_SIGNS = "%/:?#[]@!$&'()*+,;=~"
"""What stays as it is in an address (RFC 3986, reserved signs and that of codes); others, as in names of lamps, become codes."""


class HttpLine:
    """Sends the requests of a controller."""

    def __init__(self, path: Path, controller: HttpController) -> None:
        self._controller, self._where = controller, f"{path}: controllers.http"

    def send(self, command: str) -> None:
        """Send a request, given as the text of `written`.
        Raises RequestError if the controller cannot be reached, or its status is not 2xx."""
        method, given, content_type, *body = command.split(SEPARATOR)
        url = quote(given, safe=URL_SIGNS)
        request = urllib.request.Request(url, method=method, data=body[0].encode() if body else None,
                                         headers={"Content-Type": content_type} if body else {})
        try:
            with urllib.request.urlopen(request, timeout=self._controller.timeout_s) as answer:
                answer.read(1024)
        except urllib.error.HTTPError as error:
            raise RequestError(f"{self._where}: {method} {url} is answered with status {error.code}: check the request and the controller"
                               ) from error
        except (OSError, ValueError, HTTPException) as error:  # the last: it answers otherwise than by HTTP
            reason = " ".join(str(getattr(error, "reason", error)).split())
            raise RequestError(f"{self._where}: {method} {url}: no answer ({reason}): check the network and the power of the controller"
                               ) from error

    def close(self) -> None:
        """Do nothing: each request has a connection of its own."""


def written(request: HttpRequest) -> str:
    """Return a request as one text, whose fields are filled in as those of a line are."""
    parts = [request.method, request.url, request.content_type]
    return SEPARATOR.join(parts if request.body is None else [*parts, request.body])


def open_switch(path: Path, rig: Rig, ask: Ask) -> SwitchedLamps:
    """Open the way to the lamps of an HTTP controller; nobody is asked."""
    controller = rig.controllers.http
    assert controller is not None  # the rig is checked
    return SwitchedLamps(rig, "http", HttpLine(path, controller), written(controller.on), written(controller.off))
