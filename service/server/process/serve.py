"""The service: the API and its workers.

When the service is asked to end (SIGTERM or SIGINT), it still answers, and says that it is not ready, while its workers finish their steps
and return their jobs. Then requests and streams of events end, and then the service. At a second signal it ends at once, and its jobs are
taken over, as after a crash.
"""

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, cast

import uvicorn
from anyio import to_thread

from service.errors import RequestError
from service.server.api.app import Routes, create_app
from service.server.base import telemetry
from service.server.base.log import logger
from service.server.base.settings import Settings
from service.server.database.engine import Database, open_database
from service.server.jobs.queue import JobQueue, prepare
from service.server.jobs.supervisor import Supervisor
from service.server.process import connections, devices
from service.server.process.hook_sender import HookSender
from service.server.process.housekeeping import Housekeeper
from service.server.process.processes import configure, hear_signals
from service.server.storage.objects import Storage, open_storage

CLOSE_S = 5
"""Seconds that open requests, streams of events among them, may take to end when the service ends."""
THREADS = 20
"""Threads in which the API waits for the database and for files: two for each connection of the database. The 40 that anyio allows come and
go as it happens, and take 60 KB each."""


def serve(settings: Settings, *, before_answering: Callable[[str, Database, JobQueue, Storage], None] | None = None,
          set_routes: Routes | None = None) -> None:
    """Serve until SIGTERM or SIGINT, then let steps and requests end.
    `before_answering`: gets the address and the parts of the service. `set_routes`: take captures at this machine, for the page /set.
    Raises RequestError: the service cannot listen."""
    supervisors: list[Supervisor] = []
    asked = hear_signals(supervisors)
    configure(settings)
    limits = connections.limits_of(settings, connections.raise_descriptors())
    listening = _listen(settings)
    database = open_database(settings, prepare)
    supervisor = Supervisor(settings, devices.of_workers(settings))
    supervisors.append(supervisor)
    tracing = telemetry.provider(settings)
    app = create_app(settings, database, tracing, max_streams=limits.connections // 2, set_routes=set_routes)
    server = http_server(app, settings, limits)
    housekeeper = Housekeeper(settings, database, open_storage(settings), JobQueue(database))
    sender = HookSender(settings, database)
    host = f"[{settings.host}]" if ":" in settings.host else settings.host
    address = f"http://{host}:{listening.getsockname()[1]}"
    print(f"relit    {address}/v1", flush=True)
    print(f"data     {settings.data}", flush=True)
    if set_routes is not None:
        print(f"set      {address}/set", flush=True)
    if before_answering is not None:
        before_answering(address, database, app.state.service.queue, app.state.service.storage)

    def end() -> None:
        asked.get()
        logger.info("service drains")
        app.state.service.draining.set()
        try:
            housekeeper.stop()
            supervisor.stop()
            sender.stop()
        finally:
            app.state.service.closing.set()
            server.should_exit = True

    supervisor.start()
    housekeeper.start()
    sender.start()
    ending = threading.Thread(target=end, name="relit-end", daemon=True)
    ending.start()
    try:
        server.run(sockets=[listening])
    finally:
        asked.put(0)  # if the server ended without a signal
        ending.join()
        database.close()
        telemetry.close(tracing)
        logger.info("service ended")


class _Server(uvicorn.Server):
    """A server without signal handlers: those of uvicorn would end it at the first signal."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        to_thread.current_default_thread_limiter().total_tokens = THREADS
        await super().startup(sockets)
        for listening in sockets or ():
            listening.listen(connections.BACKLOG)  # asyncio has made it connections.AT_ONCE, which it uses for both

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def http_server(app: Any, settings: Settings, limits: connections.ConnectionLimits) -> uvicorn.Server:
    """Return the HTTP server around an ASGI app, without signal handlers."""
    connection = partial(connections.GuardedConnection, connections.Connections(limits))
    return _Server(uvicorn.Config(
        app, http=cast(type[asyncio.Protocol], connection), ws="none", log_config=None, access_log=False, server_header=False,
        timeout_graceful_shutdown=CLOSE_S, backlog=connections.AT_ONCE, proxy_headers=bool(settings.trusted_proxies),
        forwarded_allow_ips=list(settings.trusted_proxies)))


def _listen(settings: Settings) -> socket.socket:
    try:
        family, *_, address = socket.getaddrinfo(settings.host, settings.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        listening = socket.create_server((str(address[0]), settings.port), family=family, backlog=connections.BACKLOG)
        # connections inherit it: without it the body of an answer waits 40 ms for the client to acknowledge the headers
        listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return listening
    except OSError as error:  # gaierror too
        why = (error.strerror or "").partition(" (")[0]
        raise RequestError(f"cannot listen on host {settings.host}, port {settings.port}: {why}") from None
