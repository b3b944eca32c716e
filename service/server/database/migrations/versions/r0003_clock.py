"""The time at the last housekeeping, by which a jump of the clock is noticed."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Add a table."""
    op.create_table("relit_clock", sa.Column("id", sa.Integer, primary_key=True), sa.Column("seen_at", sa.Float, nullable=False),
                    sa.Column("waits_s", sa.Float, nullable=False))
