"""Collects the records of many stations in one PostgreSQL database. Needs the extra `plant`."""
