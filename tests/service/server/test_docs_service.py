"""docs/service.md: the walk runs as it stands, and what it says about keys, routes and metrics is so."""

import configparser
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import httpx2
import pytest

from service.requests.keys import Scope
from service.server.base.settings import Settings
from service.server.process.connections import AT_ONCE, MAX_CONNECTIONS, OWN_DESCRIPTORS
from service.server.process.processes import PRIVATE
from tests.service.server_process import environment_with
from tests.service.waiting import free_port, until

HOME = Path(__file__).parents[3]
TEXT = (HOME / "docs" / "service.md").read_text(encoding="utf-8")
PORT = "8470"


@pytest.mark.long
@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not installed")
def test_the_walk_runs(tmp_path):
    port = str(free_port())
    script = "\n".join(re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL)).replace(PORT, port)
    assert script.count(port) >= 2
    (tmp_path / "samples").symlink_to(HOME / "samples")
    environment = environment_with(port=port, devices="cpu", min_free_bytes=0)
    environment["PATH"] = f"{Path(sys.executable).parent}:{environment['PATH']}"
    walk = subprocess.Popen(["bash", "-euo", "pipefail", "-c", script], cwd=tmp_path, env=environment, text=True, start_new_session=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        out, err = walk.communicate(timeout=240)
    finally:
        if walk.poll() is None:
            os.killpg(walk.pid, signal.SIGKILL)
    assert walk.returncode == 0, (out[-3000:], err[-3000:])
    events = re.findall(r'^data: .*"state":"(\w+)"', out, re.MULTILINE)
    assert events[-1] == "succeeded"
    assert out.splitlines()[-1] == "report.json" and "frame.0008.exr" in out and '"maps.exr"' in out
    assert (tmp_path / "asset.usdz").stat().st_size > 1000


def test_the_systemd_unit_leaves_room_for_all_connections_and_time_to_drain():
    unit = configparser.ConfigParser(interpolation=None)
    unit.optionxform = str
    unit.read_string(re.search(r"```ini\n(.*?)```", TEXT, re.DOTALL)[1])
    service, settings = unit["Service"], Settings()
    assert int(service["LimitNOFILE"]) >= MAX_CONNECTIONS + AT_ONCE + OWN_DESCRIPTORS
    assert float(service["TimeoutStopSec"]) > settings.drain_s + 15
    assert int(service["UMask"], 8) == PRIVATE and service["KillMode"] == "mixed"  # `relit serve` itself ends its workers
    assert service["ExecStart"].split()[1:] == ["serve", "--config", "/etc/relit.toml"]
    assert re.findall(r"^\| `(\w+)` \| (?:captures|also)", TEXT, re.MULTILINE) == [scope.value for scope in Scope]


@pytest.mark.long
def test_the_service_of_the_demo_says_what_to_try_and_that_works(tmp_path):
    """`relit demo --serve`, without the demo itself."""
    assert "relit demo --serve" in (HOME / "Makefile").read_text() and "make serve" in TEXT
    code = ("import sys; from pathlib import Path; from service.cli.commands.demo import open_service\n"
            "open_service(Path(sys.argv[1]), 'cpu')")
    with open(tmp_path / "log", "w") as log:
        process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "data")], cwd=HOME, text=True, stdout=subprocess.PIPE,
                                   stderr=log, env=os.environ | {"RELIT_PORT": "0", "RELIT_DRAIN_S": "1", "RELIT_MIN_FREE_BYTES": "0"})
    try:
        said = [process.stdout.readline() for _ in range(7)]
        urls = [re.search(r"http://\S+", line)[0] for line in (said[0], said[2], said[3])]
        body = json.loads(re.search(r"-d '(.*)'", said[4])[1])
        with httpx2.Client(timeout=60) as client:
            until(lambda: {client.get(url).json()["state"] for url in urls[1:]} == {"ready"}, "not ready", every_s=0.1)
            assert client.post(f"{urls[0]}/jobs", json=body).status_code == 202
            assert len(client.get(f"{urls[0]}/captures").json()["items"]) == 1
    finally:
        process.terminate()
        assert process.wait(90) == 0, (tmp_path / "log").read_text()


def test_the_tests_that_the_code_names_exist():
    def found(folder: Path, pattern: str) -> set[str]:
        return {name for file in folder.rglob("*.py") for name in re.findall(pattern, file.read_text())}

    named = found(HOME / "service" / "server", r"\btest_\w+")
    assert len(named) > 5 and named <= found(HOME / "tests" / "service" / "server", r"def (test_\w+)")
