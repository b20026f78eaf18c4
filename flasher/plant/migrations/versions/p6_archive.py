"""Files with retired records."""

from alembic import op

revision = "6"
down_revision = "5"


def upgrade() -> None:
    op.create_index("attachment_by_sha256", "attachment", ["sha256"])
