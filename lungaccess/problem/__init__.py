"""What is asked: a patient, a system of devices, a target."""
