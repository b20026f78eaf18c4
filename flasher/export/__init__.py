"""Exports for engineers' tools: a Wireshark dissector, a DBC, decoded signals."""
