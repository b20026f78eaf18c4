"""The changes of the schema, for Alembic: one module each in `versions`, run by `upgrade`.

A change is a new module there, the same change in `schema`, and the next `SCHEMA_VERSION`. It says
what it does itself and imports nothing of the records, which go on to change. Triggers are not its
matter: they are all created again after the last change.
"""
