"""Welling and MOTINOVA CAN protocol: message tables, codecs, CRC, timings, frame lengths."""
