"""Signed releases: containers, signatures, trusted keys, and the log of releases.

- `container`: the file `*.wfw`, a zip with exactly one form
- `keys`: public keys and what signs with private ones
- `envelope`: signatures around bytes (DSSE)
- `statement`: what is signed about images (in-toto)
- `trust`: which keys may sign what, version by version
- `transparency`: the log of all releases
- `store`: what this computer trusts, and what it has seen
- `verify`: the checks of a release before anything is sent
- `build`: how a release comes about

Verifying is `verify.provenance_of`; `flasher.jobs.open_image` does it for each upgrade.
"""
