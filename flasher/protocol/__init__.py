"""Protocol documents as data and pure functions: no clock, no bus, no state but receive buffers."""
