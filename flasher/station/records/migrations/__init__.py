"""Schema migrations for Alembic: one module each in `versions`, run by `upgrade`.

A change needs a new module, the same change in `schema`, and the next `SCHEMA_VERSION`. The module
imports nothing from the records, which change later. All triggers are created again at the end.
"""
