"""How often each key may ask over all API processes; no key has asked while the service is upgraded."""

import sqlalchemy as sa
from alembic import op

revision = "0009"
down_revision = "0008"


def upgrade() -> None:
    """Add the table."""
    op.create_table(
        "relit_rates",
        sa.Column("key", sa.String(32), primary_key=True),
        sa.Column("tokens", sa.Float, nullable=False),
        sa.Column("counted_at", sa.Float, nullable=False),
        sa.Column("leases", sa.JSON, nullable=False),
        sa.Column("full_at", sa.Float, nullable=False))
