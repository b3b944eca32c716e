"""The size of a job's results, for the quota of bytes."""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"


def upgrade() -> None:
    """Add a column to the jobs; the results of those that have ended count nothing."""
    op.add_column("relit_jobs", sa.Column("result_bytes", sa.BigInteger, nullable=False, server_default="0"))
