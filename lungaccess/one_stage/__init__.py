"""Each stage alone."""
