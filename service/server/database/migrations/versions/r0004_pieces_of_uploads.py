"""Which request may change an upload, and its pieces in an object store, so that several API processes need not share a folder."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Add three columns to the uploads."""
    op.add_column("relit_uploads", sa.Column("writer", sa.String(32)))
    op.add_column("relit_uploads", sa.Column("writer_until", sa.Float))
    op.add_column("relit_uploads", sa.Column("pieces", sa.JSON, nullable=False, server_default="[]"))
