"""Host, device, bus and driver together; referees that share no code with flasher."""
