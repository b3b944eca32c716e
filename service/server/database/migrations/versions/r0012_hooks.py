"""Hooks of projects, and the deliveries to them."""

import sqlalchemy as sa
from alembic import op

revision = "0012"
down_revision = "0011"


def upgrade() -> None:
    """Make their tables."""
    op.create_table(
        "relit_hooks", sa.Column("id", sa.String(32), primary_key=True), sa.Column("project", sa.String(64), nullable=False),
        sa.Column("url", sa.Text, nullable=False), sa.Column("events", sa.JSON, nullable=False),
        sa.Column("secret", sa.String(64), nullable=False), sa.Column("created_at", sa.Float, nullable=False),
        sa.Column("due_at", sa.Float, nullable=False), sa.Column("failures", sa.Integer, nullable=False))
    op.create_index("relit_hooks_of_project", "relit_hooks", ["project"])
    op.create_table(
        "relit_deliveries", sa.Column("id", sa.String(32), primary_key=True),
        sa.Column("hook", sa.String(32), sa.ForeignKey("relit_hooks.id", ondelete="CASCADE"), nullable=False),
        sa.Column("event", sa.String(16), nullable=False), sa.Column("job", sa.String(32)), sa.Column("body", sa.Text),
        sa.Column("state", sa.String(16), nullable=False), sa.Column("tries", sa.Integer, nullable=False),
        sa.Column("made_at", sa.Float, nullable=False), sa.Column("tried_at", sa.Float), sa.Column("answer", sa.Text))
    op.create_index("relit_deliveries_of_hook", "relit_deliveries", ["hook", "state"])
    op.create_index("relit_deliveries_of_time", "relit_deliveries", ["made_at"])
