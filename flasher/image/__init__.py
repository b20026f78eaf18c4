"""Firmware files to the very bytes that are sent, and those bytes to packets and a plan."""
