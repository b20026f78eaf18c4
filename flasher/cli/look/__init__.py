"""Commands that look at devices, at the bus, and at what was recorded of it."""
