"""Recording of bus traffic."""
