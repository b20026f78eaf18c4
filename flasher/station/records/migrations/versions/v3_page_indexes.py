"""Indexes for the newest rows of pages and the rules of a claim, in a million runs."""

from alembic import op

revision = "3"
down_revision = "2"


def upgrade() -> None:
    op.drop_index("run_of_recipe", "run")
    op.drop_index("ix_run_lot_id", "run")
    for name, table, columns in (
        ("run_of_socket", "run", ["socket_id", "id"]),
        ("run_of_recipe", "run", ["recipe_id", "id"]),
        ("run_of_lot", "run", ["lot_id", "id"]),
        ("run_by_state", "run", ["state", "id"]),
        ("run_by_code", "run", ["code", "id"]),
        ("run_by_kind", "run", ["kind", "socket_id"]),
        ("run_by_nature", "run", ["is_virtual"]),
        ("target_with_image", "run_target", ["artifact_id", "id"]),
        ("audit_by_event", "audit", ["event", "id"]),
    ):
        op.create_index(name, table, columns)
