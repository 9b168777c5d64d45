"""Plans: what they hold, how they are stored, joined, evaluated and turned into curves."""
