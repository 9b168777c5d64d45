"""Plans made false on purpose, which the check must refuse."""
