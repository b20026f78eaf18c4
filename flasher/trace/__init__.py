"""Recordings of bus traffic: writing, reading, decoding and explaining them."""
