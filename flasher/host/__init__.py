"""Upgrades, queries and identity checks of the tool, as pure engines without bus and clock."""
