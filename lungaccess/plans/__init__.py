"""Plans: what they hold, how they are stored, joined, priced and turned into curves."""
