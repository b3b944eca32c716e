"""An import that is killed, or that a project has no room for, leaves nothing in the capture, and can be done again."""


import pytest

from service.errors import RequestError
from service.requests.base.identifiers import CAPTURE
from service.requests.base.import_choices import ImportChoices
from service.requests.jobs import CheckJob
from service.server.database import intakes, uploads
from service.server.jobs.context import Job
from service.server.storage import layout
from service.server.storage.folder import FolderStorage
from service.server.storage.objects import open_storage
from tests.marks import first_short
from tests.scenes.foreign import write_photographs
from tests.service.server.jobs.harness import PROJECT, do_step

ON_SQLITE = pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
CHOICES = ImportChoices(layout="olat", options={"axes": "right,up,towards", "sense": "to-light"})


@pytest.fixture
def uploaded(idle_harness, tmp_path):
    """A capture whose photographs were uploaded, and which is about to be imported."""
    folder, storage = write_photographs(tmp_path / "photos"), open_storage(idle_harness.settings)
    names = sorted(path.name for path in folder.iterdir())
    with idle_harness.database.begin() as connection:
        identifier = intakes.insert(connection, project=PROJECT, kind=CAPTURE, name="dropped")
        for name in names:
            uploads.insert(connection, project=PROJECT, intake=identifier, path=name, length=(folder / name).stat().st_size, made=True)
        intakes.begin_check(connection, identifier)
    for name in names:
        storage.put(folder / name, layout.intake(PROJECT, identifier), name)
    return identifier, names


def run(harness, identifier, choices=CHOICES, **settings):
    job = Job("job_0123456789abcdefghjk", PROJECT, CheckJob(kind="check", intake=identifier, importing=choices), 1)
    do_step(job, harness.context(**settings))


def stored(harness, identifier):
    files = open_storage(harness.settings).files(layout.intake(PROJECT, identifier))
    return [file.name for file in files], [row["path"] for row in uploads.listing(harness.database, identifier, limit=100)]


class Killed(BaseException):
    """As if the process had ended."""


def run_killed(harness, identifier, monkeypatch, last):
    """Run an import that is killed before or after what it made is stored."""
    put = FolderStorage.put

    def killed(self, *arguments):
        if last == "after":
            put(self, *arguments)
        raise Killed

    with monkeypatch.context() as patched:
        patched.setattr(FolderStorage, "put", killed)
        with pytest.raises(Killed):
            run(harness, identifier)


@pytest.mark.long
@pytest.mark.parametrize("database_url", ["sqlite", "postgresql"], indirect=True)
@pytest.mark.parametrize("last", ["before", "after"])
def test_an_import_that_is_killed_is_done_again_as_if_nothing_had_been(idle_harness, uploaded, monkeypatch, last):
    identifier, names = uploaded
    run_killed(idle_harness, identifier, monkeypatch, last)
    assert intakes.find(idle_harness.database, identifier, PROJECT)["state"] == "checking"
    assert stored(idle_harness, identifier)[1] == names
    run(idle_harness, identifier)
    assert stored(idle_harness, identifier) == (["capture.json", *names],) * 2
    assert intakes.find(idle_harness.database, identifier, PROJECT)["state"] == "ready"
    assert list(idle_harness.settings.data.rglob(".import-*")) == []


@ON_SQLITE
@first_short("limit", ["max_project_bytes", "max_project_pixels"])
def test_a_project_without_room_for_what_is_made_has_its_files_as_before(idle_harness, uploaded, limit):
    """The photographs have 9 × 32 × 32 pixels, and capture.json some hundred bytes."""
    identifier, names = uploaded
    used = sum(row["length"] for row in uploads.listing(idle_harness.database, identifier, limit=100))
    with pytest.raises(RequestError, match=f"quota {limit}"):
        run(idle_harness, identifier, **{limit: {"max_project_bytes": used + 10, "max_project_pixels": 9 * 32 * 32 - 1}[limit]})
    assert stored(idle_harness, identifier) == (names,) * 2


@pytest.mark.long
@ON_SQLITE
def test_an_import_that_was_killed_after_its_capture_was_ready_changes_nothing_when_it_is_run_again(idle_harness, uploaded):
    """The capture's own pixels use the quota up, which would refuse it if they were asked for twice."""
    identifier, names = uploaded
    run(idle_harness, identifier)
    made, = idle_harness.settings.data.rglob(f"captures/{identifier}/capture.json")
    before = intakes.find(idle_harness.database, identifier, PROJECT), made.read_bytes()
    run(idle_harness, identifier, max_project_pixels=9 * 32 * 32)
    assert stored(idle_harness, identifier) == (["capture.json", *names],) * 2
    assert (intakes.find(idle_harness.database, identifier, PROJECT), made.read_bytes()) == before
    asked = []
    intakes.accept(idle_harness.database, identifier, {}, asked.append)
    assert asked == []


@ON_SQLITE
def test_a_capture_json_that_was_uploaded_stays_and_its_import_is_refused(idle_harness, uploaded, tmp_path):
    identifier, names = uploaded
    own, length = tmp_path / "own.json", 5
    own.write_text("{" * length)
    idle_harness.database.transact(lambda connection: uploads.insert(
        connection, project=PROJECT, intake=identifier, path="capture.json", length=length, made=True))
    open_storage(idle_harness.settings).put(own, layout.intake(PROJECT, identifier), "capture.json")
    with pytest.raises(RequestError, match=r"^capture\.json: was uploaded and stays as it is"):
        run(idle_harness, identifier, max_project_pixels=1)
    kept, = idle_harness.settings.data.rglob("capture.json")
    assert kept.read_text() == "{" * length
    assert stored(idle_harness, identifier) == (["capture.json", *names],) * 2


@pytest.mark.long
@ON_SQLITE
def test_what_a_killed_import_has_left_is_not_taken_for_the_capture(idle_harness, uploaded, monkeypatch):
    identifier, names = uploaded
    run_killed(idle_harness, identifier, monkeypatch, "after")
    intakes.refuse(idle_harness.database, identifier, "its worker was lost too often")
    idle_harness.database.transact(lambda connection: intakes.begin_check(connection, identifier))
    with pytest.raises(RequestError, match=r"capture\.json"):
        run(idle_harness, identifier, None)
    assert stored(idle_harness, identifier) == (names,) * 2


@pytest.mark.long
@ON_SQLITE
def test_an_import_that_fails_in_any_way_takes_what_it_made_away(idle_harness, uploaded, monkeypatch):
    identifier, names = uploaded

    def broken(*_, **__):
        raise RuntimeError

    with monkeypatch.context() as patched:
        patched.setattr(uploads, "insert", broken)
        with pytest.raises(RuntimeError):
            run(idle_harness, identifier)
    assert stored(idle_harness, identifier) == (names,) * 2
