"""Claims that were released because their station does not return."""

revision = "10"
down_revision = "9"


def upgrade() -> None:
    """Do nothing: these are new tables."""
