"""The event streams that each API process has open; none is open while the service is upgraded."""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0007"


def upgrade() -> None:
    """Add the table."""
    op.create_table(
        "relit_streams",
        sa.Column("process", sa.String(32), primary_key=True),
        sa.Column("project", sa.String(64), primary_key=True),
        sa.Column("key", sa.String(32), primary_key=True),
        sa.Column("open", sa.Integer, nullable=False),
        sa.Column("until", sa.Float, nullable=False))
