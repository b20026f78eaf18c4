"""Recipes that the plant gives out, and who published or withdrew them."""

revision = "4"
down_revision = "3"


def upgrade() -> None:
    """Do nothing: these are new tables."""
