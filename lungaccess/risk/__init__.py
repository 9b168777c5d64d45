"""What happens when the devices deviate from a plan."""
