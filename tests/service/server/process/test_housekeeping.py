"""What the service clears away by itself, and what it leaves alone; days pass by an injected clock."""

import os
from contextlib import closing

import sqlalchemy as sa

from service.requests.base.identifiers import CAPTURE, ENVIRONMENT, new_id
from service.requests.jobs import ExportJob
from service.server.database import audit, idempotency, intakes, jobs, tables, uploads, workers
from service.server.process import housekeeping
from service.server.process.housekeeping import DAY_S, HOUR_S, UNFINISHED_S, Housekeeper
from service.server.storage import layout
from service.server.storage.upload_parts import open_upload_parts
from tests.service.server.process.house import DAYS, PROJECT, House
from tests.service.waiting import until


def test_old_jobs_go_with_their_results_and_their_place_in_the_queue(house):
    old = [house.job(state) for state in jobs.ENDED]
    house.now += 0.9 * DAYS * DAY_S
    young = house.job()
    waiting, running = house.job(jobs.QUEUED), house.job(jobs.RUNNING)
    capture, sky = house.capture(), house.capture(ENVIRONMENT)
    house.round()
    assert all(house.results(job).exists() for job in [*old, young])
    house.round(0.2 * DAYS * DAY_S)
    left = {row["id"] for row in jobs.latest(house.database, PROJECT, limit=100)}
    assert left == {young, waiting, running}
    assert {path.name for path in house.results(young).parent.iterdir()} == left
    assert house.workflows() == {f"{job}.1" for job in left}
    house.round(1000 * DAYS * DAY_S)
    assert {row["id"] for row in jobs.latest(house.database, PROJECT, limit=100)} == {waiting, running}
    assert intakes.find(house.database, capture, PROJECT) and intakes.find(house.database, sky, PROJECT)


def test_without_retention_jobs_stay_and_marks_of_removed_ones_do_not(tmp_path):
    house = House(tmp_path / "data")
    job = house.job()
    house.storage.remove(layout.results(PROJECT, house.job()))
    for kind in (CAPTURE, ENVIRONMENT):  # without a file, of which no writer is under way
        house.storage.remove(layout.intake(PROJECT, house.capture(kind)))
    marks = [path for path in house.settings.data.glob("removed/**/*") if path.is_file()]
    house.round()
    assert len(marks) == 1 and marks[0].exists()
    os.utime(marks[0], (0, 0))
    house.round(100_000 * DAY_S)
    assert house.results(job).exists() and jobs.find(house.database, job) and not marks[0].exists()
    house.database.close()


def test_results_that_a_waiting_job_reads_stay_until_it_has_ended(house):
    solved = house.job()
    reader = house.job(jobs.QUEUED, inputs=(solved,), request=ExportJob(kind="export", maps=solved))
    house.round(2 * DAYS * DAY_S)
    assert house.results(solved).exists()
    house.database.transact(lambda connection: jobs.cancel(connection, reader))
    house.round()
    assert not house.results(solved).exists() and jobs.find(house.database, solved) is None


def test_uploads_that_nobody_goes_on_with_expire(house):
    capture, folder = house.capture(), house.settings.part_files
    parts = open_upload_parts(house.settings, house.database, house.storage)
    with house.database.begin() as connection:
        upload, done = (uploads.insert(connection, project=PROJECT, intake=capture, path=path, length=10) for path in ("a", "b"))
    assert uploads.finish(house.database, done, 10)
    with closing(parts.open({"id": upload})) as part:
        part.append([b"12345"])
    parts.open({"id": "up_orphan"}).close()
    house.round(47 * HOUR_S)
    assert uploads.find(house.database, upload, PROJECT) and {path.stem for path in folder.iterdir()} == {upload, "up_orphan"}
    house.now += 2 * HOUR_S
    with closing(parts.open({"id": upload})):  # a request adds to it
        house.round()
        assert uploads.find(house.database, upload, PROJECT)
    house.round()
    assert uploads.find(house.database, upload, PROJECT) is None and list(folder.iterdir()) == []
    assert uploads.find(house.database, done, PROJECT) and intakes.find(house.database, capture, PROJECT)


def test_tokens_are_remembered_for_a_day_and_lines_of_the_audit_log_for_audit_days(house):
    made: list[str] = []

    def make(_connection) -> str:
        made.append(new_id(CAPTURE))
        return made[-1]

    def ask() -> str:
        return idempotency.create_once(house.database, PROJECT, "token", ["x"], make)

    ask()
    house.round(0.9 * DAY_S)
    assert ask() == made[0]
    house.round(0.2 * DAY_S)
    assert ask() == made[1]
    house.database.transact(lambda connection: audit.record_operator(connection, PROJECT, "key.create", "key_1"))
    house.round(397.5 * DAY_S)
    assert len(audit.listing(house.database, limit=9)) == 1
    house.round(2 * DAY_S)  # in which the clock jumps
    assert len(audit.listing(house.database, limit=9)) == 0


def test_workers_that_are_gone_are_forgotten_and_those_that_come_back_are_not(house):
    for name in ("dead", "alive"):
        workers.insert(house.database, name, host="h", pid=1, device="cpu")
    locks = house.settings.locks
    locks.mkdir()
    (locks / "dead.lock").write_bytes(b"")

    def known() -> set[str]:
        return {row["id"] for row in house.database.rows(sa.select(tables.workers))}

    house.round(2 * HOUR_S)  # as after a database that was away
    assert known() == {"dead", "alive"}
    house.database.transact(lambda connection: connection.execute(
        tables.workers.update().where(tables.workers.c.id == "alive").values(seen_at=house.now)))
    house.round()
    assert known() == {"alive"}
    assert (locks / "dead.lock").exists() != house.settings.is_sqlite  # on PostgreSQL locks are no files, and this is none of ours


def test_stack_caches_go_with_their_captures_and_what_a_killed_worker_began_goes_later(house):
    kept, gone = house.capture(), house.capture()
    folders = house.cache(kept), house.cache(gone)
    half = house.settings.data / "cache" / f".{new_id(CAPTURE)}.removed"
    half.mkdir()
    begun = folders[0] / ".stack.abc.npy"
    begun.write_bytes(b"half")
    house.round()
    assert folders[0].exists() and folders[1].exists() and not half.exists() and begun.exists()  # it may be in the making
    house.database.transact(lambda connection: intakes.remove(connection, gone))
    house.round(UNFINISHED_S + HOUR_S)
    assert (folders[0] / "stack.npy").exists() and not folders[1].exists() and not begun.exists()


def test_beyond_their_limit_the_caches_go_that_were_not_read_for_longest(tmp_path):
    house = House(tmp_path / "data", cache_bytes=2500)
    captures = [house.capture() for _ in range(4)]
    folders = [house.cache(capture) for capture in captures]
    in_use = house.job(jobs.QUEUED, inputs=(captures[1],))
    last = house.job(inputs=(captures[0],))
    for moment, job in enumerate((in_use, last)):
        house.database.transact(lambda connection, job=job, at=house.now + 100 + moment: connection.execute(
            tables.jobs.update().where(tables.jobs.c.id == job).values(updated_at=at)))
    house.round()  # 4000 bytes: two go, those that no job has read
    assert [folder.exists() for folder in folders] == [True, True, False, False]
    house.database.transact(lambda connection: connection.execute(
        tables.jobs.update().where(tables.jobs.c.id == in_use).values(updated_at=house.now - 100)))
    unread = house.cache(house.capture())
    house.round()  # the oldest is in use, the next is the one that no job has read since it was made
    assert [folder.exists() for folder in (*folders[:2], unread)] == [True, True, False]
    house.database.close()


def test_the_thread_makes_a_round_at_once_and_ends_when_it_is_asked(house):
    folder = house.cache(new_id(CAPTURE))
    house.keeper.start()
    until(lambda: not folder.exists())
    house.keeper.stop()


def test_what_is_half_removed_or_made_again_of_a_deleted_job_is_removed(house):
    """The worker deletes what it made again at the end of its step, unless it is killed before.

    Results that no job of the database knows stay: it may be another database that is pointed at them.
    """
    deleted, kept, restored = house.job(), house.job(), house.job()
    house.database.transact(lambda connection: jobs.remove(connection, deleted))
    for job in (deleted, restored):  # `restored` stands for one that a backup brought back
        house.storage.remove(layout.results(PROJECT, job))
        assert not house.results(job).exists()
        house.results(job).mkdir()
        (house.results(job) / "frame.0001.exr").write_bytes(b"frame")
    half, stray = house.results(kept).with_name(f".{new_id('job')}.removed"), house.results("job_00000000000000000000")
    for folder in (half, stray):
        folder.mkdir()
        (folder / "frame.0001.exr").write_bytes(b"frame")
    house.round()
    assert [house.results(job).exists() for job in (deleted, kept, restored)] == [False, True, True]
    assert not half.exists() and stray.exists()
    house.round(10 * DAYS * DAY_S)
    assert stray.exists()


def test_one_bad_row_stops_neither_the_other_rows_nor_the_thread(house, monkeypatch):
    """As a value in a request that PostgreSQL cannot read did, for all projects and for good; it is logged once."""
    bad, away, good = house.job(), house.job(), house.job()
    house.now += 2 * DAYS * DAY_S
    remove, failing = jobs.remove, {bad: ValueError("no such character"), away: OSError("no such disk")}

    def fail(connection, job):
        if job in failing:
            raise failing[job]
        return remove(connection, job)

    monkeypatch.setattr(jobs, "remove", fail)
    logged = []
    monkeypatch.setattr(housekeeping.logger, "error", lambda event, **fields: logged.append((event, fields["piece"])))
    stale = house.cache(new_id(CAPTURE))
    house.round()
    house.round()
    assert [jobs.find(house.database, job) is None for job in (bad, away, good)] == [False, False, True] and not stale.exists()
    assert logged == [("housekeeping failed", bad)]


def jump(house, seconds):
    """The clock is set, and no time passes."""
    house.now += seconds
    house.jumped += seconds


def test_a_clock_that_jumps_removes_nothing_at_once(house):
    job = house.job()
    house.round()
    jump(house, 20 * 365 * DAY_S)
    for hours in (0, 10, 23):
        house.round(hours * HOUR_S / 2)
        assert house.results(job).is_dir() and jobs.find(house.database, job) is not None
    jump(house, -20 * 365 * DAY_S)  # the operator has seen it
    house.round()
    house.round(0.9 * DAYS * DAY_S)  # as time passes, and nobody touches the clock
    assert house.results(job).is_dir()
    house.round(0.1 * DAYS * DAY_S)
    assert not house.results(job).exists() and jobs.find(house.database, job) is None


def test_a_clock_that_stays_ahead_is_believed_after_a_day(house):
    job = house.job()
    house.round()
    jump(house, 60 * DAY_S)
    house.round()
    house.round(0.9 * DAY_S)
    assert house.results(job).is_dir()
    house.round(0.2 * DAY_S)
    assert not house.results(job).exists()


def test_a_machine_that_starts_with_another_year_removes_nothing_at_once(house):
    """The process that saw the time before is gone."""
    job = house.job()
    house.round()
    for seconds in (9 * 365 * DAY_S, 0.0):
        house.now += seconds
        house.keeper = Housekeeper(house.settings, house.database, house.storage, house.queue, clock=lambda: house.now,
                                   monotonic=lambda: house.now)
        house.round()
        assert house.results(job).is_dir()


def test_a_clock_that_is_set_right_by_minutes_is_no_jump(house):
    job = house.job()
    house.round()
    house.now += 1.01 * DAYS * DAY_S
    jump(house, -600)
    house.round()
    assert not house.results(job).exists()
