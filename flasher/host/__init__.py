"""The tool's side as pure engines: protocol and image, without bus and clock."""
