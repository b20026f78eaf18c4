"""Active runs and the reports of PCs that were taken over."""

from alembic import op

from flasher.plant import takeover_functions

revision = "3"
down_revision = "2"


def upgrade() -> None:
    op.execute("""
ALTER TABLE plant_station ADD COLUMN other_refusal text NOT NULL DEFAULT '',
    ADD COLUMN other_reported_at timestamptz
""")
    connection = op.get_bind().execution_options(no_parameters=True)
    for statement in (takeover_functions.CLOSE, takeover_functions.ONCE):
        connection.exec_driver_sql(statement)
