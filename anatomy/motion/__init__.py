"""Motion of the lungs by breathing: read or modelled, brought to the frame of the masks, and bounded."""
