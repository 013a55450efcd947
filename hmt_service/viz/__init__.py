"""Figures, the report of a run, and the view in Rerun."""
