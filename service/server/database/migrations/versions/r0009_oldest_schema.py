"""The schema of the oldest databases that are upgraded, those of relit 0.1.0."""

revision = "0009"
down_revision = None


def upgrade() -> None:
    """Change nothing: service.server.database.schema refuses older databases."""
