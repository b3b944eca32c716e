"""The version of the program that began each job, so that no job mixes the results of two; lines of the audit log by their time."""

import sqlalchemy as sa
from alembic import op

revision = "0011"
down_revision = "0010"


def upgrade() -> None:
    """Add a column to the jobs, of which those that are under way are made anew; put one index in place of another."""
    op.add_column("relit_jobs", sa.Column("version", sa.String(64)))
    op.execute(sa.text("UPDATE relit_jobs SET version = ''"))
    op.drop_index("relit_audit_of_project", "relit_audit")
    op.create_index("relit_audit_of_time", "relit_audit", ["at"])
