"""``splatpipe error``: what a setting costs in error and saves in time and bytes, as work–precision diagrams.

=============  ==========================================================================================
module         owns
=============  ==========================================================================================
``config``     the TOML file: base run, scenes, sweeps; every point of every sweep as one configuration
``reference``  the frames that errors are measured against: every point, float64, kept on disk
``picture``    a frame as the bytes that leave the machine, and what those bytes show
``sweep``      the two passes: first time alone, then error alone
``report``     the table, the diagrams with their Pareto front, the omissions
``command``    the command
=============  ==========================================================================================
"""
