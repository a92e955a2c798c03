"""The performance model of ``splatpipe model``: does each part of each rank keep up with the frame rate? (thesis ch. 3)

==============  ======================================================================
module          owns
==============  ======================================================================
parameters      the system and application parameters of thesis Table 3-1, with units
inequalities    the conditions (1)–(8) of thesis 3.3.1 in their time form
system_file     both kinds of parameters as a TOML file
probes          what one rank measures: CPU, memory, GL transfers, rasterizer
links           what a pair of ranks measures: messages
fit             a latency and a rate from timed samples
measure         the rank program that runs the probes, and who starts it
application     application parameters from an instrumented run
errata          where the thesis misprints, beside its worked example
command         the command: parameters measured or read, conditions evaluated
present         what it says: tables, JSON, report
==============  ======================================================================
"""
