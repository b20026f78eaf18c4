"""Pages in a browser: events in, HTML out. No logic lives here: a page shows what the station or
the `Device` says, and hands on what a person does.

`server` runs an ASGI application in a thread; `guard` lets nobody else in; `feed` carries states to
the pages, each message with the whole state of its subject, so that a page that lost its connection
needs no replay; `translation` says it in another language.
"""
