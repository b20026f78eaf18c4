"""Indexes for pages over a million runs."""

from alembic import op

revision = "3"
down_revision = "2"


def upgrade() -> None:
    op.create_index("run_of_socket", "run", ["socket_id", "id"])
