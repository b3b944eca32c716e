"""Bodies of JSON: read after the caller is known, in bounded time, and parsed outside the event loop, up to the first fault."""

import asyncio
import json
from collections.abc import Callable, Coroutine
from typing import Any

from fastapi import Request, Response
from fastapi.routing import APIRoute
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException

from service.server.api.context import authenticated

BODY_S = 30.0
"""Seconds that a body may take to arrive; it has at most middleware.MAX_BYTES."""
MAX_DEPTH = 32
"""Lists and objects inside one another; a job has eight."""
MAX_FIELDS = 100
"""Fields of one object; a job has at most thirty. Each unknown one is a fault, which costs a hundred times what sending it does."""


class JsonRoute(APIRoute):
    """A route that looks at who sends a request before it looks at the body."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Return the handler of requests."""
        handle = super().get_route_handler()

        async def known(request: Request) -> Response:
            if self.body_field is not None:
                await authenticated(request)
            return await handle(_JsonRequest(request.scope, request.receive))

        return known


class _JsonRequest(Request):
    async def body(self) -> bytes:
        try:
            async with asyncio.timeout(BODY_S):
                return await super().body()
        except TimeoutError:
            raise HTTPException(400, f"the body did not come within {BODY_S:g} s") from None

    async def json(self) -> Any:
        return await run_in_threadpool(parse, await self.body())


def parse(body: bytes) -> Any:
    """Return what a body of JSON says; refuse one that is nested too deeply, has too many fields, or is not UTF-8 text."""
    try:
        found = json.loads(body.decode(), object_pairs_hook=_object)
        _require_shallow(found)
    except UnicodeDecodeError:
        raise HTTPException(400, "the body is not UTF-8 text") from None
    except RecursionError:
        raise HTTPException(422, f"the body is nested more than {MAX_DEPTH} levels deep") from None
    return found


def _object(fields: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(fields) > MAX_FIELDS:
        raise HTTPException(422, f"an object of the body has {len(fields)} fields, {MAX_FIELDS} are allowed")
    return dict(fields)


def _require_shallow(found: Any) -> None:
    """Raise RecursionError, as the reader of JSON does at a greater depth, for what is nested more than MAX_DEPTH levels deep."""
    level = [found]
    for _ in range(MAX_DEPTH):
        level = [inner for outer in level if isinstance(outer, dict | list)
                 for inner in (outer.values() if isinstance(outer, dict) else outer)]
        if not level:
            return
    if any(isinstance(inner, dict | list) for inner in level):
        raise RecursionError
