"""Commands for signed releases and for the keys that this computer trusts."""
