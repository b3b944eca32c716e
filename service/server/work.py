"""One worker alone, without the API and its libraries, as a machine beside that of the API runs it."""

from service.server import devices, telemetry
from service.server.database.engine import open_database
from service.server.jobs.queue import prepare
from service.server.jobs.supervisor import Supervisor
from service.server.processes import configure, hear_signals
from service.server.settings import Settings


def work(settings: Settings, device: str | None) -> None:
    """Run one worker, which is started again when it dies, until SIGTERM or SIGINT."""
    supervisors: list[Supervisor] = []
    asked = hear_signals(supervisors)
    configure(settings)
    open_database(settings, prepare).close()
    telemetry.close(telemetry.provider(settings))  # so that a missing extra is reported here, and not by every worker
    supervisors.append(Supervisor(settings, [devices.resolve(device)]))
    supervisors[0].start()
    asked.get()
    supervisors[0].stop()
