"""Benchmarks of ``splatpipe bench``: each measures, beside others in the same run, and prints what it found."""
