"""A client of the service for Python programs; docs/client.md explains its use."""

from service.client.client import Client
from service.client.errors import (
    Busy,
    ClientError,
    Conflict,
    Faulty,
    FileError,
    IntakeRefused,
    Invalid,
    JobEnded,
    NotAllowed,
    NotFound,
    Refused,
    Unreachable,
)

__all__ = ["Busy", "Client", "ClientError", "Conflict", "Faulty", "FileError", "IntakeRefused", "Invalid", "JobEnded", "NotAllowed",
           "NotFound", "Refused", "Unreachable"]
