"""Settings files: one reader, with one style of error messages."""
