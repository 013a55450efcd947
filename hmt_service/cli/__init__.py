"""The command `hmt`."""
