"""Recipes that the plant gives out, and who published or withdrew them."""

import sqlalchemy as sa
from alembic import op

revision = "4"
down_revision = "3"


def upgrade() -> None:
    moment = sa.DateTime(timezone=True)
    op.create_table(
        "released_file",
        sa.Column("sha256", sa.Text, primary_key=True),
        sa.Column("data", sa.LargeBinary, nullable=False),
        sa.CheckConstraint("sha256 = encode(sha256(data), 'hex')", name="file_is_whole"),
    )
    op.create_table(
        "released_recipe",
        sa.Column("digest", sa.Text, primary_key=True),
        sa.Column("manifest", sa.Text, nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("revision", sa.Text, nullable=False),
        sa.Column("part", sa.Text, nullable=False),
        sa.CheckConstraint(
            "digest = encode(sha256(convert_to(manifest, 'UTF8')), 'hex')", name="recipe_is_whole"
        ),
    )
    op.create_table(
        "recipe_event",
        sa.Column("id", sa.BigInteger, sa.Identity(always=True), primary_key=True),
        sa.Column("at", moment, nullable=False, server_default=sa.func.clock_timestamp()),
        sa.Column("by", sa.Text, nullable=False, server_default=sa.text("session_user")),
        sa.Column("what", sa.Text, nullable=False),
        sa.Column(
            "digest", sa.Text, sa.ForeignKey("released_recipe.digest"), nullable=False, index=True
        ),
        sa.Column("station", sa.Text, sa.ForeignKey("plant_station.name")),
        sa.Column("socket", sa.Text),
        sa.Column("reason", sa.Text, nullable=False, server_default=""),
        sa.CheckConstraint("what IN ('published', 'withdrawn')", name="event_is_known"),
    )
