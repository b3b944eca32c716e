"""Keys that expire, when each was used last, and the audit log."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"


def upgrade() -> None:
    """Add two columns to the keys, and a table."""
    op.add_column("relit_keys", sa.Column("expires_at", sa.Float))
    op.add_column("relit_keys", sa.Column("used_at", sa.Float))
    op.create_table(
        "relit_audit", sa.Column("id", sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True),
        sa.Column("project", sa.String(64), nullable=False), sa.Column("at", sa.Float, nullable=False),
        sa.Column("actor", sa.String(200), nullable=False), sa.Column("action", sa.String(40), nullable=False),
        sa.Column("object", sa.String(40), nullable=False), sa.Column("request", sa.String(32)))
    op.create_index("relit_audit_of_project", "relit_audit", ["project", "id"])
