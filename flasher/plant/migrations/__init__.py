"""Changes of the plant's database, in Alembic's form; run by `setup`."""
