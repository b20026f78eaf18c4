"""Bootloader conformance suite: cases that check the protocol, bus faults and timing."""
