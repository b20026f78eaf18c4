"""Receivers of runs, and how far each run's hand-over to them has come."""

revision = "5"
down_revision = "4"


def upgrade() -> None:
    """Do nothing: these are new tables."""
