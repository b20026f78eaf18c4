"""Traces of bus traffic: recording, reading, decoding and explaining."""
