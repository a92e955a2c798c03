"""The holistic model: what a run would cost on settings, ranks and machines it was not measured on.

==============  =================================================================================
module          owns
==============  =================================================================================
``recurrence``  ranks and frames → start and finish times (max-plus), throughput, bottleneck
``costs``       measured runs → seconds a cell, an entry, a point, a pixel, a message
``workload``    configuration → how many of each a frame has, without drawing
``forecast``    costs · workload → ranks → frames/s; cores that ranks share; what-if
``hybrid``      k : m : n ranks on paper, to thousands
``validate``    predicted beside measured, on runs that the costs were not fitted on
``report``      what was predicted, for people
``command``     ``splatpipe predict``
==============  =================================================================================
"""
