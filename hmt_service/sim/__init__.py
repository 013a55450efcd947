"""Simulated worlds, sensors and trajectories."""
