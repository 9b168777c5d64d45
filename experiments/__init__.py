"""Studies of the planners, one script each: `python -m experiments.NAME [--quick]`."""
