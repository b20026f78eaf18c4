"""Recording of bus traffic, with python-can's own writers."""
