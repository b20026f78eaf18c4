"""Commands of the end-of-line station."""
