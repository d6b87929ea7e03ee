"""The operator's page: one HTML page, one websocket, served by the service itself.

protocol.py     messages to and from a browser, as bytes: no socket, no clock
live_view.py    the newest of everything that the page shows, kept from the service's messages
send_queue.py   what waits for one browser: its answers, and the newest of each thing
tile_stream.py  map tiles newer than a browser's version, deflated once for all browsers
resources.py    stored sessions and maps: list, rename, delete, export, look at, edit
jobs.py         the processes in which these are exported, looked at and edited
access.py       token, Host, Origin, response headers
server.py       the thread with its own event loop that serves all of it
static/         the page: plain ES modules, rendered on a canvas; no build step, no external resource
"""
