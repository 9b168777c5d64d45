"""Sweeps of patients, targets, devices, planners and seeds, with their results in one SQLite file."""
