"""The holistic model: what a run would cost on settings, ranks and machines it was not measured on.

==============  =================================================================================
module          owns
==============  =================================================================================
``recurrence``  ranks and frames → start and finish times (max-plus), throughput, bottleneck
``costs``       measured runs → seconds a cell, an entry, a point, a pixel, a message
``workload``    configuration → how many of each a frame has, without drawing
``parts``       of these, what falls to each tile, share and set of subtrees
``machine``     cores, hosts and links: said, or measured by ranks on them
``setting``     topology, ranks, threads
``steps``       layout · parts · costs → what each rank and link has to do, and after what
``forecast``    steps on the cores that ranks share → frames/s, latency, what limits
``scaling``     every topology on paper, to thousands of ranks
``hybrid``      which k : m : n suit a scene
``whatif``      one thing changed
``validate``    predicted beside measured, on runs that the costs were not fitted on
``report``      what was predicted, for people
``command``     ``splatpipe predict``
==============  =================================================================================
"""
