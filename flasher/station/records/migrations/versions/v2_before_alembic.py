"""The schema before Alembic: records of it have no revision, and are taken over as they are."""

revision = "2"
down_revision = None


def upgrade() -> None:
    """Nothing: these tables are there."""
