"""Commands for a bench: the device model, and the suite that tests a bootloader."""
