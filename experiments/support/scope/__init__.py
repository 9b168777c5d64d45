"""Goals, ends and timings for the bronchoscope advisor."""
