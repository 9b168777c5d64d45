"""The devices, one package each: bronchoscope, concentric tubes and steerable needle."""
