"""Files: log readers, the map file, trajectories and ground truth."""
