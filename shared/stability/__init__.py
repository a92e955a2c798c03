"""Stiff and extreme cases of the mathematics that every rank agrees on; ``case`` says what a case is.

The suite is the cases of three packages, each beside what it tests: ``shared.stability`` (mathematics),
``nodes.stability`` (scenes built, culled, sampled and drawn) and ``cluster.stability`` (messages, models, and the
command that runs them all). A module adds a case by defining one; ``cluster.stability.suite`` names the modules.

==================  ============================================================
module              owns
==================  ============================================================
``case``            what a case is, how it is run, its verdict
``eigenvalues``     flatness of a cell against 50 digits
``neighbourhoods``  normals, splat radii and cell features
``cameras``         matrices and poses against 50 digits; keyframe paths
``codecs``          what the codecs will be held to
``linear_groups``   any ε, ends that nearly coincide, matrices that stretch or flatten
``grids``           keys, centres and normals against integers and rationals
==================  ============================================================
"""
