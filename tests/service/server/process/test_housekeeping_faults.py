"""What the service clears away when a piece of the work fails, and when its clock is set."""


from service.requests.base.identifiers import CAPTURE, new_id
from service.server.database import jobs
from service.server.process import housekeeping
from service.server.process.housekeeping import DAY_S, HOUR_S, Housekeeper
from tests.service.server.process.house import DAYS


def test_one_piece_that_fails_does_not_stop_the_others(house, monkeypatch):
    def fail(*_arguments: object) -> None:
        raise OSError("no such disk")

    old = house.job()
    house.now += 2 * DAYS * DAY_S
    monkeypatch.setattr(type(house.storage), "remove", fail)
    capture = house.cache(new_id(CAPTURE))
    house.keeper.round()
    assert not capture.exists() and jobs.find(house.database, old) is None


def test_one_bad_row_stops_neither_the_other_rows_nor_the_thread(house, monkeypatch):
    """As a value in a request that PostgreSQL cannot read did, for all projects and for good; it is logged once."""
    bad, good = house.job(), house.job()
    house.now += 2 * DAYS * DAY_S
    forget = housekeeping._forget

    def fail(connection, job):
        if job == bad:
            raise ValueError("no such character")
        return forget(connection, job)

    monkeypatch.setattr(housekeeping, "_forget", fail)
    logged = []
    monkeypatch.setattr(housekeeping.logger, "error", lambda event, **fields: logged.append((event, fields["piece"])))
    stale = house.cache(new_id(CAPTURE))
    house.keeper.round()
    house.keeper.round()
    assert jobs.find(house.database, bad) and jobs.find(house.database, good) is None and not stale.exists()
    assert logged == [("housekeeping failed", bad)]


def jump(house, seconds):
    """The clock is set, and no time passes."""
    house.now += seconds
    house.jumped += seconds


def test_a_clock_that_jumps_removes_nothing_at_once(house):
    job = house.job()
    house.keeper.round()
    jump(house, 20 * 365 * DAY_S)
    for hours in (0, 10, 23):
        house.now += hours * HOUR_S / 2
        house.keeper.round()
        assert house.results(job).is_dir() and jobs.find(house.database, job) is not None
    jump(house, -20 * 365 * DAY_S)  # the operator has seen it
    house.keeper.round()
    house.now += 0.9 * DAYS * DAY_S  # as time passes, and nobody touches the clock
    house.keeper.round()
    assert house.results(job).is_dir()
    house.now += 0.1 * DAYS * DAY_S
    house.keeper.round()
    assert not house.results(job).exists() and jobs.find(house.database, job) is None


def test_a_clock_that_stays_ahead_is_believed_after_a_day(house):
    job = house.job()
    house.keeper.round()
    jump(house, 60 * DAY_S)
    house.keeper.round()
    house.now += 0.9 * DAY_S
    house.keeper.round()
    assert house.results(job).is_dir()
    house.now += 0.2 * DAY_S
    house.keeper.round()
    assert not house.results(job).exists()


def test_a_machine_that_starts_with_another_year_removes_nothing_at_once(house):
    """The process that saw the time before is gone."""
    job = house.job()
    house.keeper.round()
    for seconds in (9 * 365 * DAY_S, 0.0):
        house.now += seconds
        house.keeper = Housekeeper(house.settings, house.database, house.storage, house.queue, clock=lambda: house.now,
                                   monotonic=lambda: house.now)
        house.keeper.round()
        assert house.results(job).is_dir()


def test_a_clock_that_is_set_right_by_minutes_is_no_jump(house):
    job = house.job()
    house.keeper.round()
    house.now += 1.01 * DAYS * DAY_S
    jump(house, -600)
    house.keeper.round()
    assert not house.results(job).exists()
