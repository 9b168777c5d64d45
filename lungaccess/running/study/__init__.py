"""Studies: patients, targets, devices, planners and seeds from one file, results in one SQLite file."""
