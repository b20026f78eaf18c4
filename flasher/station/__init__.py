"""End-of-line station: flashes units in sockets by a recipe, and records their verdicts.

PASS is shown only after it is on disk, and a PASS on disk is true.
"""
