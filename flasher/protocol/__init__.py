"""The protocol documents as data and pure functions: no clock, no bus, no state beyond a buffer."""
