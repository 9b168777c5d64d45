"""Plans: what they hold, their files and costs, and their devices as curves."""
