"""The tables. They lie beside those of the job queue, so that one transaction can write both."""

from typing import Any

import sqlalchemy as sa

SCHEMA_VERSION = 1
"""Raised with every change of a table; a database of another version is refused."""

metadata = sa.MetaData()
Bytewise = sa.Text().with_variant(sa.Text(collation="C"), "postgresql")
"""Text in the order of its bytes, as SQLite has it anyway."""


def _id() -> "sa.Column[str]":
    return sa.Column("id", sa.String(32), primary_key=True)


def _project() -> "sa.Column[str]":
    return sa.Column("project", sa.String(64), nullable=False)


about = sa.Table("relit_about", metadata, sa.Column("version", sa.Integer, primary_key=True))

keys = sa.Table(
    "relit_keys", metadata, _id(), _project(),
    sa.Column("name", sa.String(200), nullable=False),
    sa.Column("scope", sa.String(8), nullable=False),
    sa.Column("digest", sa.String(64), nullable=False),  # SHA-256 of the secret, hexadecimal
    sa.Column("created_at", sa.Float, nullable=False),  # every time: seconds since 1970, UTC
    sa.Column("revoked_at", sa.Float))

intakes = sa.Table(  # captures and environments
    "relit_intakes", metadata, _id(), _project(),
    sa.Column("kind", sa.String(16), nullable=False),
    sa.Column("name", sa.String(200), nullable=False),
    sa.Column("folder", sa.Text),  # registered, where it is on the server; NULL: uploaded
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("problem", sa.Text),  # why it was refused
    sa.Column("facts", sa.JSON),  # what the check found
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Index("relit_intakes_of_project", "project", "kind", "created_at"))

uploads = sa.Table(
    "relit_uploads", metadata, _id(), _project(),
    sa.Column("intake", sa.String(32), sa.ForeignKey("relit_intakes.id"), nullable=False),
    sa.Column("path", sa.Text, nullable=False),  # within the capture
    sa.Column("folded", Bytewise, nullable=False),  # the path where upper and lower case are one
    sa.Column("length", sa.BigInteger, nullable=False),
    sa.Column("received", sa.BigInteger, nullable=False),  # bytes that are safe on disk
    sa.Column("sha256", sa.String(64)),  # of the whole file, hexadecimal, where the client said it
    sa.Column("touched_at", sa.Float, nullable=False),
    sa.Column("done", sa.Boolean, nullable=False),
    sa.UniqueConstraint("intake", "folded", name="relit_uploads_of_path"))

jobs = sa.Table(
    "relit_jobs", metadata, _id(), _project(),
    sa.Column("key", sa.String(32)),  # who asked; NULL: anonymous, or the service itself
    sa.Column("request", sa.JSON, nullable=False),  # service.requests.jobs
    sa.Column("trace", sa.String(64)),  # traceparent of the request that made it, where traces are made
    sa.Column("chunk_frames", sa.Integer, nullable=False),
    sa.Column("priority", sa.Integer, nullable=False),
    sa.Column("state", sa.String(16), nullable=False),
    sa.Column("attempt", sa.Integer, nullable=False),  # begins at 1; a retry is the next
    sa.Column("revision", sa.BigInteger, nullable=False),  # grows with every change
    sa.Column("created_at", sa.Float, nullable=False),
    sa.Column("updated_at", sa.Float, nullable=False),
    sa.Column("started_at", sa.Float),
    sa.Column("finished_at", sa.Float),
    sa.Column("worker", sa.String(200)),
    sa.Column("lost", sa.Integer, nullable=False),  # workers that died since the job last came further
    sa.Column("reached", sa.Integer, nullable=False),  # the most frames that it had in this attempt
    sa.Column("finished_steps", sa.JSON, nullable=False),  # names, of all attempts
    sa.Column("stage", sa.String(100)),
    sa.Column("done", sa.Integer),
    sa.Column("total", sa.Integer),
    sa.Column("rate", sa.Float),  # per second
    sa.Column("error", sa.Text),  # one sentence
    sa.Index("relit_jobs_of_project", "project", "created_at"),
    sa.Index("relit_jobs_of_state", "state", "updated_at"))

job_inputs = sa.Table(  # captures, environments and jobs that a job reads
    "relit_job_inputs", metadata,
    sa.Column("job", sa.String(32), sa.ForeignKey("relit_jobs.id", ondelete="CASCADE"), primary_key=True),
    sa.Column("input", sa.String(32), primary_key=True, index=True))

idempotency = sa.Table(
    "relit_idempotency", metadata, _project(),
    sa.Column("token", sa.String(255), nullable=False),
    sa.Column("fingerprint", sa.String(64), nullable=False),  # of what was asked
    sa.Column("made", sa.String(32), nullable=False),  # identifier of what was created
    sa.Column("created_at", sa.Float, nullable=False),
    sa.PrimaryKeyConstraint("project", "token"))

workers = sa.Table(
    "relit_workers", metadata, sa.Column("id", sa.String(200), primary_key=True),
    sa.Column("host", sa.String(200), nullable=False),
    sa.Column("pid", sa.Integer, nullable=False),
    sa.Column("device", sa.String(100), nullable=False),
    sa.Column("started_at", sa.Float, nullable=False),
    sa.Column("seen_at", sa.Float, nullable=False),
    sa.Column("state", sa.String(16), nullable=False))


def newest_first(query: "sa.Select[Any]", table: sa.Table, *, limit: int, before: tuple[float, str] | None) -> "sa.Select[Any]":
    """A page of rows, by the time of their creation.

    Args:
        query: of rows of the table.
        table: jobs or intakes.
        limit: how many at most.
        before: creation time and identifier of the last row of the page before; None: the first page.
    """
    if before is not None:
        query = query.where(sa.tuple_(table.c.created_at, table.c.id) < sa.tuple_(*before))
    return query.order_by(table.c.created_at.desc(), table.c.id.desc()).limit(limit)
