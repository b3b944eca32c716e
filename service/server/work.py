"""One worker alone, without the API and its libraries, as a machine beside that of the API runs it."""

from service.server import devices, telemetry
from service.server.database.engine import Database, open_database
from service.server.database.schema import is_current
from service.server.jobs.supervisor import Supervisor
from service.server.processes import configure, hear_signals
from service.server.settings import Settings


def work(settings: Settings, device: str | None) -> None:
    """Run one worker, which is started again when it dies, until SIGTERM or SIGINT."""
    supervisors: list[Supervisor] = []
    asked = hear_signals(supervisors)
    configure(settings)
    open_database(settings, _prepare).close()
    telemetry.close(telemetry.provider(settings))  # so that a missing extra is reported here, and not by every worker
    supervisors.append(Supervisor(settings, [devices.resolve(device)]))
    supervisors[0].start()
    asked.get()
    supervisors[0].stop()


def _prepare(settings: Settings, database: Database) -> None:
    """Make or upgrade the tables where that is to do; the worker looks at those of the queue, whose library this process need not load."""
    settings.data.mkdir(parents=True, exist_ok=True)
    if not is_current(database):
        from service.server.jobs.queue import prepare

        prepare(settings, database)
