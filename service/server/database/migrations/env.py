"""Alembic runs this file to upgrade a database; service.server.database.schema gives the connection, which is in a transaction."""

from alembic import context

from service.server.database.schema import REVISIONS
from service.server.database.tables import metadata

context.configure(connection=context.config.attributes["connection"], target_metadata=metadata, version_table=REVISIONS,
                  render_as_batch=True)  # SQLite changes a column only by a new table
with context.begin_transaction():
    context.run_migrations()
