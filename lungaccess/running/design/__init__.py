"""The search over the numbers of a device: which device reaches most of a cohort, or most often succeeds."""
