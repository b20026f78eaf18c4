"""Links, the simulated bus, the driver loop, the python-can adapter."""
