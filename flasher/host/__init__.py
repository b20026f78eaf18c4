"""The tool's side as pure machines: they know the protocol and the image, no bus and no clock."""
