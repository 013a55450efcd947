"""Benchmarks of the whole chain: numbers with a unit and a direction, and their gate."""
