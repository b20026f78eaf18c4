"""Device model of upgradable devices, written from the documents alone: it shares only
`flasher.protocol` with the host.
"""
