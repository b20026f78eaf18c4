"""Alembic environment: runs migrations on the connection and in the transaction of `setup`."""

from alembic import context

from flasher.plant.schema import VERSION_TABLE

context.configure(connection=context.config.attributes["connection"], version_table=VERSION_TABLE)
context.run_migrations()
