"""The benchmark synthetic-v1: fixed phantoms and targets, submissions of any planner, scores by the check."""
