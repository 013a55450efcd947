"""Benchmarks: measured numbers of the whole chain, each with a unit and a direction."""
