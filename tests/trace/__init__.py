"""Traces and watching."""
