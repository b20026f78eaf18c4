"""Firmware images: file formats, checks, releases, and the plan of packets to send."""
