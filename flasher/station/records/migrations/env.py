"""Alembic's environment: runs the changes on the connection, in the transaction, of `upgrade`."""

from alembic import context

context.configure(connection=context.config.attributes["connection"])
context.run_migrations()
