"""The first schema, which `setup` creates whole."""

revision = "1"
down_revision = None
