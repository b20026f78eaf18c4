"""Simulated upgrades with faults, from seeds."""
