"""CAN links: real adapters through python-can, and a simulated bus with exact bit times."""
