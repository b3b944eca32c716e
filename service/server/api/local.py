"""A service that asks for no key: programs of this machine may use it, and neither a proxy nor a page of another site in a browser."""

from urllib.parse import urlsplit

from fastapi import Request

from service.server.api.problems import ApiError
from service.server.settings import is_loopback

FORWARDED = ("forwarded", "x-forwarded-for", "x-forwarded-host", "x-real-ip", "via")
"""What proxies add to a request."""


def require_local(request: Request) -> None:
    """Let in what this machine itself asks.

    A page that a browser of this machine shows can send requests to a loopback address: by its own name, which it has made to point
    there (the Host tells), or across sites (the Origin tells).

    Raises:
        ApiError: it came through a proxy, or from a page of another site.
    """
    host = request.headers.get("host", "")
    if not is_loopback(_name(host)):
        raise ApiError("forbidden", "without a key, the Host must be localhost or a loopback address")
    if any(name in request.headers for name in FORWARDED):
        raise ApiError("forbidden", "without a key, requests through a proxy are refused: make keys with relit keys create")
    origin = request.headers.get("origin")
    if origin is not None and origin not in (f"http://{host}", f"https://{host}"):
        raise ApiError("forbidden", "without a key, requests from pages of other sites are refused")


def _name(host: str) -> str:
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""
