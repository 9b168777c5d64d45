"""The coupled planner: searches for plans of all three stages."""
