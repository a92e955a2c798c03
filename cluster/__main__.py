"""``python -m splatpipe.cluster``: the same as ``splatpipe``; how ranks are started."""

from .cli import main

main()
