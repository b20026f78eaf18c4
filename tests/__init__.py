"""Tests of flasher."""
