"""``python -m splatpipe.cluster``: the same as ``splatpipe``; how ranks are started."""

from .launch import beat
from .watch import attach

attach(beat)

from .cli import main  # noqa: E402  what takes time to import comes after

main()
