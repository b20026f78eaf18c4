"""The commands of the end-of-line station."""
