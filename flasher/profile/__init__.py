"""The target profile: what the documents leave open, or a product does its own way (TOML)."""

from flasher.profile.load import FILE_NAME, check_profile, find_profile, load_profile
from flasher.profile.model import ApplicationArea, Profile, VersionAnswer, VersionQuery

__all__ = [
    "load_profile",
    "find_profile",
    "check_profile",
    "FILE_NAME",
    "Profile",
    "ApplicationArea",
    "VersionQuery",
    "VersionAnswer",
]
