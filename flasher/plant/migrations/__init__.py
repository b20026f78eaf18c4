"""Changes of the plant's database, in Alembic's form; run by `setup`.

`setup` first creates the tables that are missing, as `schema` has them now: a module here alters
older ones and fills new ones. What it adds to a table that a newer version made may be there.
"""
