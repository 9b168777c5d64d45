"""What errors and the breath do to a plan."""
