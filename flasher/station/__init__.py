"""The end-of-line station: recipes, sockets, records and reports of flashed units.

The first rule: PASS is shown only after it is on disk, and a PASS on disk is true.
"""
