"""Commands that read devices, watch the bus and work on recorded traces."""
