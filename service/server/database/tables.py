"""The tables of the service. They are in the same database as those of DBOS, so that one transaction can write both.

A change of a table needs a revision in `migrations/versions`, which changes the databases that exist (service.server.database.schema).
"""

import time
from typing import Any

import sqlalchemy as sa

metadata = sa.MetaData()
Bytewise = sa.Text().with_variant(sa.Text(collation="C"), "postgresql")
"""Text that is ordered by its bytes; SQLite orders all text so."""


def _id() -> "sa.Column[str]":
    return sa.Column("id", sa.String(32), primary_key=True)


def _project() -> "sa.Column[str]":
    return sa.Column("project", sa.String(64), nullable=False)


keys = sa.Table(
    "relit_keys", metadata, _id(), _project(),
    sa.Column("name", sa.String(200), nullable=False),
    sa.Column("scope", sa.String(8), nullable=False),
    sa.Column("digest", sa.String(64), nullable=False),  # SHA-256 of the secret, hexadecimal
    sa.Column("created_at", sa.Float, nullable=False),  # every time: seconds since 1970, UTC
    sa.Column("revoked_at", sa.Float),
    sa.Column("expires_at", sa.Float),  # NULL: never
    sa.Column("used_at", sa.Float))  # of the last request, to a minute

audit = sa.Table(  # who did what to which object; triggers refuse to change lines (service.server.database.audit)
    "relit_audit", metadata, sa.Column("id", sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True), _project(),
    sa.Column("at", sa.Float, nullable=False),
    sa.Column("actor", sa.String(200), nullable=False),  # a key, a user of an identity provider, anonymous, or an operator
    sa.Column("action", sa.String(40), nullable=False),
    sa.Column("object", sa.String(40), nullable=False),  # identifier
    sa.Column("request", sa.String(32)),  # identifier of the HTTP request, which the log has too; NULL: the command line
    sa.Index("relit_audit_of_time", "at"))

intakes = sa.Table(  # captures and environments
    "relit_intakes", metadata, _id(), _project(),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("name", sa.String(200), nullable=False),
    sa.Column("folder", sa.Text),  # where a registered one lies on the server; NULL: it was uploaded
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("problem", sa.Text),  # why it was refused
    sa.Column("facts", sa.JSON),  # what the check found
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Index("relit_intakes_of_project", "project", "kind", "created_at"))

annotations = sa.Table(  # texts about points and rectangles of captures
    "relit_annotations", metadata, _id(),
    sa.Column("intake", sa.String(32), sa.ForeignKey("relit_intakes.id", ondelete="CASCADE"), nullable=False),
    sa.Column("content", sa.JSON, nullable=False),  # of service.requests.base.annotations
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Index("relit_annotations_of_intake", "intake", "created_at"))

uploads = sa.Table(
    "relit_uploads", metadata, _id(), _project(),
    sa.Column("intake", sa.String(32), sa.ForeignKey("relit_intakes.id"), nullable=False),
    sa.Column("path", sa.Text, nullable=False),  # within the capture
    sa.Column("folded", Bytewise, nullable=False),  # the path without the difference of upper and lower case
    sa.Column("length", sa.BigInteger, nullable=False),
    sa.Column("received", sa.BigInteger, nullable=False),  # bytes that are on the disk for certain
    sa.Column("sha256", sa.String(64)),  # of the whole file, hexadecimal; NULL: the client did not say it
    sa.Column("touched_at", sa.Float, nullable=False),
    sa.Column("done", sa.Boolean, nullable=False),
    # with an object store: the request that may change the row, and until when; name and bytes of each piece in the store
    sa.Column("writer", sa.String(32)),
    sa.Column("writer_until", sa.Float),
    sa.Column("pieces", sa.JSON, nullable=False, server_default="[]"),
    sa.UniqueConstraint("intake", "folded", name="relit_uploads_of_path"))

jobs = sa.Table(
    # DBOS records a workflow for each attempt of a job: its queue, the worker that took it, its priority and whether it has ended. Where a
    # column repeats a fact that DBOS records too, its comment gives the reason; the tests named are in tests/service/server.
    "relit_jobs", metadata, _id(), _project(),
    sa.Column("key", sa.String(32)),  # identifier of the API key that submitted it; NULL: anonymous, or the service
    sa.Column("request", sa.JSON, nullable=False),  # of service.requests.jobs
    sa.Column("trace", sa.String(64)),  # traceparent of the HTTP request that submitted it; NULL: it was not traced
    sa.Column("chunk_frames", sa.Integer, nullable=False),  # frames of a step: the steps stay the same when the setting changes
    # as the API shows it, also after the workflows of the job are deleted; JobQueue.set_priority writes both in one transaction
    # (test_a_changed_priority_is_that_of_the_queue)
    sa.Column("priority", sa.Integer, nullable=False),
    # of the job over all attempts. DBOS changes the status of a workflow in transactions of its own, and `revision` has to grow in the
    # same transaction as the state, or a stream of events misses the change (test_a_job_that_is_cancelled_and_resumed_is_told)
    sa.Column("state", sa.String(16), nullable=False),
    # number of the workflow, from 1. A retry is a new workflow: DBOS does not resume one that has ended, and a worker that has not yet
    # noticed the end of the old one must change nothing in the new one (test_a_worker_that_was_given_up_for_dead_changes_nothing_any_more)
    sa.Column("attempt", sa.Integer, nullable=False),
    sa.Column("revision", sa.BigInteger, nullable=False, onupdate=sa.text("revision + 1")),  # grows with every change
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Column("updated_at", sa.Float, nullable=False, onupdate=time.time),
    sa.Column("started_at", sa.Float),  # of the first attempt; DBOS has that of the latest start
    sa.Column("finished_at", sa.Float),
    # the worker that may change the row; DBOS has it as executor_id of the workflow. It has to stand in the row that is changed: an
    # UPDATE that waits for a takeover reads this row again, but not another (test_a_change_that_waits_for_the_takeover_changes_nothing)
    sa.Column("worker", sa.String(200)),
    # workers that died since the job last made progress, and the most frames that this attempt had. DBOS counts every start of a
    # workflow, also those after a drain or a restart of the database (test_more_frames_than_ever_before_count_as_a_finished_step)
    sa.Column("lost", sa.Integer, nullable=False),
    sa.Column("reached", sa.Integer, nullable=False),
    # names of the stages that the step under way has come to, with any worker; whether the worker is still in one that an earlier worker
    # left behind it; and the workers that died there (test_a_worker_that_dies_before_the_furthest_stage_is_not_held_against_the_job)
    sa.Column("stages_begun", sa.JSON, nullable=False, server_default="[]"),
    sa.Column("repeating", sa.Boolean, nullable=False, server_default=sa.false()),
    sa.Column("lost_repeating", sa.Integer, nullable=False, server_default="0"),
    sa.Column("version", sa.String(64)),  # of the program whose steps these are
    # names, of all attempts. DBOS could record the steps of one workflow. To keep them for a retry the workflow would have to be forked,
    # which DBOS does not do in a transaction of ours, and which drops the priority; and it records Python names, so that a renamed
    # function would end the jobs that are under way (test_a_job_that_was_given_back_goes_on_with_the_steps_that_are_left)
    sa.Column("finished_steps", sa.JSON, nullable=False),
    sa.Column("stage", sa.String(100)),
    sa.Column("done", sa.Integer),
    sa.Column("total", sa.Integer),
    sa.Column("rate", sa.Float),  # per second
    sa.Column("error", sa.Text),  # one sentence
    sa.Column("result_bytes", sa.BigInteger, nullable=False, server_default="0"),  # of its results, after the last finished step
    sa.Index("relit_jobs_of_project", "project", "created_at"),
    sa.Index("relit_jobs_of_state", "state", "updated_at"))

job_inputs = sa.Table(  # the captures, environments and jobs that a job reads
    "relit_job_inputs", metadata,
    sa.Column("job", sa.String(32), sa.ForeignKey("relit_jobs.id", ondelete="CASCADE"), primary_key=True),
    sa.Column("input", sa.String(32), primary_key=True, index=True))

job_log = sa.Table(  # what happened to each job, for its page
    "relit_job_log", metadata,
    sa.Column("number", sa.Integer, primary_key=True, autoincrement=True),
    sa.Column("job", sa.String(32), sa.ForeignKey("relit_jobs.id", ondelete="CASCADE"), nullable=False, index=True),
    sa.Column("at", sa.Float, nullable=False),
    sa.Column("attempt", sa.Integer, nullable=False),
    sa.Column("text", sa.Text, nullable=False))

hooks = sa.Table(  # URLs that are told how the jobs of a project ended
    "relit_hooks", metadata, _id(), _project(),
    sa.Column("url", sa.Text, nullable=False),
    sa.Column("events", sa.JSON, nullable=False),
    sa.Column("secret", sa.String(64), nullable=False),  # as it is: it signs
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Column("due_at", sa.Float, nullable=False),  # of the next try: the end of a pause, or when the try under way counts as lost
    sa.Column("failures", sa.Integer, nullable=False),  # tries since the last one that was accepted
    sa.Index("relit_hooks_of_project", "project"))

deliveries = sa.Table(  # an event and the hook to be told of it
    "relit_deliveries", metadata, _id(),
    sa.Column("hook", sa.String(32), sa.ForeignKey("relit_hooks.id", ondelete="CASCADE"), nullable=False),
    sa.Column("event", sa.String(16), nullable=False),
    sa.Column("job", sa.String(32)),  # which may have been deleted since; NULL: a test
    sa.Column("body", sa.Text),  # of the requests, with the job as it was when it ended; NULL: no try follows
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("tries", sa.Integer, nullable=False),
    sa.Column("made_at", sa.Float, nullable=False),
    sa.Column("tried_at", sa.Float),
    sa.Column("answer", sa.Text),  # to the last try: its status, or why there was none
    sa.Index("relit_deliveries_of_hook", "hook", "state"),
    sa.Index("relit_deliveries_of_time", "made_at"))

idempotency = sa.Table(
    "relit_idempotency", metadata, _project(),
    sa.Column("token", sa.String(255), nullable=False),
    sa.Column("fingerprint", sa.String(64), nullable=False),  # of what was asked
    sa.Column("made", sa.String(32), nullable=False),  # identifier of what was created
    sa.Column("created_at", sa.Float, nullable=False),
    sa.PrimaryKeyConstraint("project", "token"))

workers = sa.Table(  # for operators: DBOS keeps no list of them, and the locks that tell who lives have no device (see takeover)
    "relit_workers", metadata, sa.Column("id", sa.String(200), primary_key=True),
    sa.Column("host", sa.String(200), nullable=False),
    sa.Column("pid", sa.Integer, nullable=False),
    sa.Column("device", sa.String(100), nullable=False),
    sa.Column("started_at", sa.Float, nullable=False),
    sa.Column("seen_at", sa.Float, nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("asked", sa.String(8)))  # what an operator asks of it: drain or kill; NULL: nothing

clock = sa.Table(  # of the housekeeping, one row: by it a jump of the machine's clock is noticed
    "relit_clock", metadata, sa.Column("id", sa.Integer, primary_key=True),
    sa.Column("seen_at", sa.Float, nullable=False),  # the time at the last round
    sa.Column("waits_s", sa.Float, nullable=False))  # seconds for which nothing is removed for its age, after a jump


def newest_first(query: "sa.Select[Any]", table: sa.Table, *, limit: int, before: sa.RowMapping | None) -> "sa.Select[Any]":
    """Return the query of one page of rows, the newest first; `before` is the last row of the page before."""
    if before is not None:
        query = query.where(sa.tuple_(table.c.created_at, table.c.id) < sa.tuple_(before["created_at"], before["id"]))
    return query.order_by(table.c.created_at.desc(), table.c.id.desc()).limit(limit)
