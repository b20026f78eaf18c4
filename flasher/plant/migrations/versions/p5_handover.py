"""Receivers of runs, and how far each run's hand-over to them has come."""

import sqlalchemy as sa
from alembic import op

revision = "5"
down_revision = "4"


def upgrade() -> None:
    moment = sa.DateTime(timezone=True)
    op.create_table(
        "plant_receiver",
        sa.Column("name", sa.Text, primary_key=True),
        sa.Column("since", moment, nullable=False, server_default=sa.func.now()),
        sa.Column("stopped_at", moment),
    )
    op.create_table(
        "plant_delivery",
        sa.Column("receiver", sa.Text, nullable=False),
        sa.Column("station", sa.Uuid, nullable=False),
        sa.Column("number", sa.BigInteger, nullable=False),
        sa.Column("state", sa.Text, nullable=False, server_default="waiting"),
        sa.Column("attempts", sa.Integer, nullable=False, server_default="0"),
        sa.Column("sent_at", moment),
        sa.Column("answered_at", moment),
        sa.Column("answer", sa.Text, nullable=False, server_default=""),
        sa.Column("job", sa.BigInteger, nullable=False),
        sa.PrimaryKeyConstraint("receiver", "station", "number"),
    )
    op.create_index(
        "plant_delivery_open",
        "plant_delivery",
        ["state", "receiver"],
        postgresql_where=sa.text("state <> 'confirmed'"),
    )
    op.create_table("plant_queue", sa.Column("migration", sa.Text, primary_key=True))
