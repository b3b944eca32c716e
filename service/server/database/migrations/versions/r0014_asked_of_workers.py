"""What an operator asks of a worker."""

import sqlalchemy as sa
from alembic import op

revision = "0014"
down_revision = "0013"


def upgrade() -> None:
    """Add the column."""
    op.add_column("relit_workers", sa.Column("asked", sa.String(8)))
