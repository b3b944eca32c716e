"""Each API process counts requests and event streams in its own memory, and no longer in the database."""

from alembic import op

revision = "0010"
down_revision = "0009"


def upgrade() -> None:
    """Drop the two tables in which they were counted."""
    op.drop_table("relit_streams")
    op.drop_table("relit_rates")
