"""How far a step has come, so that a job is blamed only for workers that die where it made no progress."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Add three columns to the jobs."""
    op.add_column("relit_jobs", sa.Column("stages_begun", sa.JSON, nullable=False, server_default="[]"))
    op.add_column("relit_jobs", sa.Column("repeating", sa.Boolean, nullable=False, server_default=sa.false()))
    op.add_column("relit_jobs", sa.Column("lost_repeating", sa.Integer, nullable=False, server_default="0"))
