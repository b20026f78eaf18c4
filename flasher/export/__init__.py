"""Exports for engineering tools: Wireshark dissector, DBC, decoded signals, trace formats."""
