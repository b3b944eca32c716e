"""The schema of the databases that were made before there were migrations, which begin here: nothing to change.

Those databases hold the number 1 in `relit_about`, which their programs refuse if it is another. So it becomes 2 here, and stays so.
"""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Keep programs without migrations away."""
    op.execute(sa.text("UPDATE relit_about SET version = 2"))
