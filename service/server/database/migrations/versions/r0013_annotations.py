"""Annotations of captures."""

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"


def upgrade() -> None:
    """Make their table."""
    op.create_table(
        "relit_annotations", sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("intake", sa.String(32), sa.ForeignKey("relit_intakes.id", ondelete="CASCADE"), nullable=False),
        sa.Column("content", sa.JSON, nullable=False), sa.Column("created_at", sa.Float, nullable=False))
    op.create_index("relit_annotations_of_intake", "relit_annotations", ["intake", "created_at"])
