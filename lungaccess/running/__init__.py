"""Many runs: studies and benchmarks."""
