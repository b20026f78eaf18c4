"""Browser pages of the station and the bench, without logic of their own.

`server` runs an ASGI application in a thread; `guard` controls access; `feed` sends states to
pages: each message has the whole state of its subject, so that a page needs no replay.
"""
