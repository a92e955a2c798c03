"""Experiments: a grid of settings, each run several times in fresh processes, one tidy table and where it came from.

==============  ===========================================================================
module          owns
==============  ===========================================================================
``config``      the experiment file: what may stand in it
``grid``        the file → the list of points, each a checked run configuration
``scenes``      scenes that the experiment builds for itself
``journal``     finished runs on disk, one line each; what makes a killed experiment resume
``runner``      the order of the runs
``table``       runs → rows, medians with spread, scaling, ours beside the paper's
``report``      the HTML and Markdown report
``command``     ``splatpipe experiment``
==============  ===========================================================================
"""
