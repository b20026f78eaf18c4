"""Firmware upgrades for the Welling mid-drive e-bike system over CAN."""
