"""Hybrid metric-topological SLAM that knows how sure it is."""

__version__ = "0.1.0"
