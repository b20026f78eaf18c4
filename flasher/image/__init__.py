"""Firmware images: file formats, plausibility checks, release manifests, packet plans."""
