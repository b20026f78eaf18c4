"""Peers for the upgrade made from literal CAN frames: referees that share no code with flasher."""
