"""The end-of-line station: recipes, sockets, records and reports of flashed units.

Its rule above all: a PASS that is shown is already on disk, and a PASS on disk is true.
"""
