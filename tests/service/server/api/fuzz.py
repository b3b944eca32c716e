"""schemathesis against a server that holds one of everything: requests made of the OpenAPI document, good, bad, and in sequences."""

import subprocess
import sys
import time
from pathlib import Path

from service.requests.base.identifiers import ENVIRONMENT
from service.requests.hooks import NewHook
from service.requests.jobs import RelightJob
from service.server.base.settings import Settings
from service.server.database import hooks, intakes, jobs, tables
from tests.service.server.process.house import PROJECT, House
from tests.service.server_process import Server, environment_with, new_key

SEED = "7"
CONFIG = """
request-timeout = 20.0
max-stream-events = 1
suppress-health-check = ["all"]

[parameters]
"path.capture" = {{ dictionary = "captures", probability = 0.5 }}
"path.environment" = {{ dictionary = "environments", probability = 0.5 }}
"path.job" = {{ dictionary = "jobs", probability = 0.7 }}
"path.hook" = {{ dictionary = "hooks", probability = 0.7 }}
"path.name" = {{ dictionary = "results", probability = 0.7 }}
"body.capture" = {{ dictionary = "captures", probability = 0.7 }}
"body.environment" = {{ dictionary = "environments", probability = 0.7 }}
"body.maps" = {{ dictionary = "jobs", probability = 0.7 }}
"header.Tus-Resumable" = "1.0.0"

[dictionaries]
captures = {{ values = {captures} }}
environments = {{ values = {environments} }}
jobs = {{ values = {jobs} }}
hooks = {{ values = {hooks} }}
results = {{ values = ["maps.exr", "report.json"] }}

[generation]
database = "none"

[checks.positive_data_acceptance]
# beside the default ones: what a schema cannot say (frames that run backwards, light keys out of order), a file that is larger than
# allowed, a precondition, a range
expected-statuses = ["2xx", "304", "401", "403", "404", "409", "410", "412", "413", "416", "422"]

[[operations]]
include-operation-id = "patch_upload"
# a checksum of no algorithm is 400 by the tus protocol, and schemathesis takes a header that is empty for one of any pattern
checks.positive_data_acceptance.expected-statuses = ["204", "400", "401", "403", "404", "409", "410", "412", "413", "422", "423", "460"]
"""


def seed(settings: Settings) -> tuple[str, dict[str, list[str]]]:
    """A key, and captures, environments and jobs in several states; no worker is needed."""
    house = House(settings.data, database_url=settings.database_url)
    key = new_key(house.database, PROJECT)
    captures, environments = [house.capture() for _ in range(3)], [house.capture(ENVIRONMENT) for _ in range(2)]
    for ready in (*captures[:2], environments[0]):
        house.database.transact(lambda connection, ready=ready: intakes.begin_check(connection, ready))
        intakes.accept(house.database, ready, {"captures": 1, "frames": 96, "resolution": [320, 320]})
    relight = RelightJob(kind="relight", capture=captures[0], environment=environments[0])
    states = {jobs.SUCCEEDED: None, jobs.FAILED: None, jobs.CANCELLED: relight, jobs.QUEUED: relight}
    made = [house.job(state, inputs=(captures[0],), request=request) for state, request in states.items()]
    for job in made:
        (house.results(job) / "maps.exr").write_bytes(bytes(range(256)) * 40)
        (house.results(job) / "report.json").write_text("{}")
    house.database.transact(lambda connection: connection.execute(tables.workers.insert().values(  # one that is seen for the whole run
        id="fuzz", host="fuzz", pid=1, device="cpu", started_at=time.time(), seen_at=time.time() + 86_400, state="ready")))
    told = [house.database.transact(lambda connection: hooks.insert(connection, PROJECT, NewHook(url="https://tracker.example/")))["id"]
            for _ in range(2)]
    house.database.close()
    return key, {"captures": captures, "environments": environments, "jobs": made, "hooks": told}


def fuzz(server: Server, key: str, known: dict[str, list[str]], folder: Path, *, examples: int, phases: str, max_time_s: int | None,
         exclude: str | None = None) -> subprocess.CompletedProcess[str]:
    """Run it; its exit status is 0 where nothing is wrong. With a time it is another run every time, else always the same."""
    config = folder / "schemathesis.toml"
    config.write_text(CONFIG.format(**{name: str(values).replace("'", '"') for name, values in known.items()}))
    limits = ["--seed", SEED] if max_time_s is None else ["--max-time", str(max_time_s)]
    return subprocess.run(
        [sys.executable, __file__, "--config-file", str(config), "run", f"{server.url}/v1/openapi.json",
         "--header", f"Authorization: Bearer {key}", "--phases", phases, "--max-examples", str(examples),
         "--checks", "all", "--continue-on-failure", "--no-color", "--warnings", "off", *limits,
         *(["--exclude-operation-id-regex", exclude] if exclude else [])],
        cwd=folder, env=environment_with(), capture_output=True, text=True)


if __name__ == "__main__":  # the program of schemathesis, which also sends parts of files
    import schemathesis
    from schemathesis.cli import schemathesis as program

    @schemathesis.serializer("application/offset+octet-stream")
    def octets(_context, value):
        return value if isinstance(value, bytes) else str(value).encode()

    sys.exit(program())
