"""Families of simulated worlds, one module each."""
