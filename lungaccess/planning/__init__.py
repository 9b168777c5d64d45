"""From a request to plans, and from a measurement to the next step."""
