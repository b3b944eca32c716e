"""The processes of the service: the API with the workers that it looks after, or a worker alone."""

import multiprocessing
import signal
import threading
from collections.abc import Callable
from typing import TypeVar

import uvicorn

from service import log
from service.api.app import create_app
from service.errors import RequestError
from service.jobs.queue import prepare
from service.jobs.supervisor import Supervisor
from service.log import logger
from service.settings import Settings
from service.store.database import Database, DatabaseError, connect

T = TypeVar("T")
NO_WORKER = "none"
CLOSE_S = 5
"""How long open requests (streams of events among them) may take to end when the service ends."""


def serve(settings: Settings) -> None:
    """Serve until SIGTERM or SIGINT; then let requests and steps end.

    Raises:
        RequestError: the database cannot be used, or a device is not on this machine.
    """
    log.configure(settings.log_level, settings.log_format)
    database = _database(settings)
    supervisor = Supervisor(settings, _devices(settings))
    server = uvicorn.Server(uvicorn.Config(
        create_app(settings, database), host=settings.host, port=settings.port, log_config=None, access_log=False,
        timeout_graceful_shutdown=CLOSE_S, server_header=False))
    socket = server.config.bind_socket()
    host, port = socket.getsockname()[:2]
    print(f"relit    http://{host}:{port}/v1", flush=True)
    print(f"data     {settings.data}", flush=True)
    supervisor.start()
    try:
        server.run(sockets=[socket])
    finally:
        logger.info("service drains")
        supervisor.stop()
        database.close()


def work(settings: Settings, device: str | None) -> None:
    """One worker, started again when it dies, until SIGTERM or SIGINT."""
    log.configure(settings.log_level, settings.log_format)
    _database(settings).close()
    ending = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: ending.set())
    supervisor = Supervisor(settings, [_elsewhere(_resolve, device)])
    supervisor.start()
    ending.wait()
    supervisor.stop()


def _database(settings: Settings) -> Database:
    try:
        database = connect(settings.sqlalchemy_url)
        prepare(settings, database)
    except DatabaseError as error:
        raise RequestError(str(error)) from error
    return database


def _devices(settings: Settings) -> list[str]:
    if settings.devices == (NO_WORKER,):
        return []
    if settings.devices:
        return [_elsewhere(_resolve, device) for device in settings.devices]
    return [name for name in _elsewhere(_names) if name.startswith("cuda")] or ["cpu"]


def _elsewhere(ask: Callable[..., T], *arguments: object) -> T:
    """Ask in a process of its own: this one never touches CUDA, so that a fault of a driver does not end it."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(ask, arguments)


def _names() -> list[str]:
    from kernels.device import names

    return names()


def _resolve(device: str | None) -> str:
    from kernels.device import resolve

    return resolve(device)
