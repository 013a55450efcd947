"""Operating-system processes, queues and their life cycle."""
