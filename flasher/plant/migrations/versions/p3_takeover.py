"""Active runs and the reports of PCs that were taken over."""

import sqlalchemy as sa
from alembic import op

from flasher.plant import takeover_functions
from flasher.plant.schema import open_run

revision = "3"
down_revision = "2"


def upgrade() -> None:
    connection = op.get_bind().execution_options(no_parameters=True)
    open_run.create(connection)
    op.add_column(
        "plant_station", sa.Column("other_refusal", sa.Text, nullable=False, server_default="")
    )
    op.add_column("plant_station", sa.Column("other_reported_at", sa.DateTime(timezone=True)))
    for statement in (takeover_functions.CLOSE, takeover_functions.ONCE):
        connection.exec_driver_sql(statement)
