"""Whether there is space left for what is asked."""

import shutil

from service.server.api.context import Service
from service.server.api.problems import ApiError
from service.server.settings import Settings

RETRY_S = 600
FOR_WORK, FOR_UPLOAD = "new work", "this upload"
"""Purposes, as the sentence says them."""


def has_space(settings: Settings, length: int = 0) -> bool:
    """Whether so many bytes more leave as much space as the operator wants."""
    return shutil.disk_usage(settings.data).free - length >= settings.min_free_bytes


def require_space(service: Service, purpose: str, length: int = 0) -> None:
    """Refuse where they would not.

    Args:
        service: the service.
        purpose: FOR_WORK or FOR_UPLOAD.
        length: bytes that will be written, where that is known.
    """
    if not has_space(service.settings, length):
        raise ApiError("full", f"the service has no space left for {purpose}", headers={"Retry-After": str(RETRY_S)})
