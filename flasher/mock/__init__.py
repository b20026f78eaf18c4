"""A model of an upgradable device, written from the document alone: it shares nothing with the host
but `flasher.protocol`.
"""
