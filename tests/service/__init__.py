"""The blocking functions for service programs."""
