"""Commands that upgrade a device, or look at what would be sent."""
