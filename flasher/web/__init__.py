"""Browser pages of the station and the bench: events in, HTML out, without logic of their own.

`server` runs an ASGI application in a thread; `guard` controls access; `feed` sends states to the
pages, each message with the whole state of its subject, so that a page that lost its connection
needs no replay; `translation` translates.
"""
