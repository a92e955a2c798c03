"""One rank's work, message in → message out: culling, sampling, render.

No node imports another node, MPI or a socket; they meet only in ``shared.messages``. The rasterizers live in
``raster``; ``stability`` holds the extreme cases that need a node.
"""
