"""Commands that upgrade a device, or show the plan of an upgrade."""
