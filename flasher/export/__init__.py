"""The protocol in engineers' own tools: a dissector for Wireshark, a DBC, decoded signals."""
