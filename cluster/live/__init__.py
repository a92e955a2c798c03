"""Live: a run that a person steers and watches (``splatpipe view``).

``protocol`` says what crosses. ZeroMQ carries pictures, commands and metrics between the ranks and the hub, and between
the hub and clients that are programs; a WebSocket carries the same messages to pages. MPI carries the pipeline. Only
``sockets`` imports zmq and only ``web`` aiohttp; a run that nobody looks at imports neither.
"""
