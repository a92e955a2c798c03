"""What a run needs and what it does without: ``splatpipe plan``, and the choice of topology behind ``splatpipe run``.

``workload``    what an average frame has to do: counted and timed on a few frames of the path, or taken from a run
``costs``       what a unit of each kind of work costs
``topology``    one rank or three: estimates, decision with its reason
``needs``       every part of the program: needed or left out, why, and the gain of leaving it out
``picture_needs``  those behind the rasterizer; ``part``: what a part is, and the names
``ablation``    with and without a part, in turn: the time saved, and that the pictures are the same bits
``whole_runs``  the same for what only whole runs show: ranks, film, imports
``command``     the command: tables, JSON, report
"""
