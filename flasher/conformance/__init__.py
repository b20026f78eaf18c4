"""The conformance suite: does a bootloader follow the protocol, case by case, and how fast."""
