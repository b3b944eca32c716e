"""`relit demo --serve`: the service has the results of the demo, so that its pages show them at once."""

from pathlib import Path

import pytest

from service.server.base.settings import Settings
from service.server.database import intakes, jobs
from service.server.database.keys import DEFAULT_PROJECT
from service.server.jobs.queue import JobQueue
from service.server.process.sample import SampleResults, show_sample
from service.server.storage import layout
from service.server.storage.objects import open_storage
from tests.service.server.prepared import opened

SAMPLE = Path(__file__).resolve().parents[4] / "samples" / "owl"


@pytest.fixture
def made(tmp_path) -> SampleResults:
    """Files that stand for the results of the demo."""
    def files(folder: str, *names: str) -> list[Path]:
        (tmp_path / folder).mkdir()
        found = [tmp_path / folder / name for name in names]
        for path in found:
            path.write_text(f"{folder} {path.name}")
        return found

    return SampleResults(files("demo", "maps.exr", "report.json", "asset.usdz", "frame.0001.exr"),
                         files("capture", "view.json", "view.bin"), files("maps", "view.json", "view.bin"))


def test_the_results_of_the_demo_are_those_of_jobs_that_have_succeeded(tmp_path, made, capsys):
    settings = Settings(data=tmp_path / "data")
    storage = open_storage(settings)
    with opened(settings) as database:
        for _ in range(2):  # the second start adds nothing
            show_sample("http://x", database, JobQueue(database), storage, SAMPLE, made)
        rows = {(row["request"]["kind"], row["request"].get("maps") is not None): row
                for row in jobs.latest(database, DEFAULT_PROJECT, states=["succeeded"], limit=500)}
        assert set(rows) == {("pipeline", False), ("view", True), ("view", False)}
        assert rows["view", True]["request"]["maps"] == rows["pipeline", False]["id"]
        assert len({row["request"]["capture"] for row in rows.values()}) == 1
        for key, folder in {("pipeline", False): "demo", ("view", True): "maps", ("view", False): "capture"}.items():
            prefix = layout.results(DEFAULT_PROJECT, rows[key]["id"])
            stored = {file.name: (storage.local(prefix) / file.name).read_text() for file in storage.files(prefix)}
            assert stored == {path.name: f"{folder} {path.name}" for path in made[("demo", "capture", "maps").index(folder)]}
        assert "pages    http://x/" in capsys.readouterr().out
        for _ in range(2):  # without results, too, it is registered once
            show_sample("http://x", database, JobQueue(database), storage, SAMPLE, None)
        assert len(intakes.latest(database, DEFAULT_PROJECT, "cap", limit=9)) == 1
