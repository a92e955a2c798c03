"""Putting nodes on ranks: topologies, transport, launch, frame loop, outputs, benchmarks and the command line."""
