"""Ways to a bus: a real adapter, a simulated bus with exact bit times, and what they share."""
