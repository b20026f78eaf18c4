"""Schema 2, before Alembic: such records have no revision, and need no change."""

revision = "2"
down_revision = None


def upgrade() -> None:
    """Do nothing: the tables exist."""
