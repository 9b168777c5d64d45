"""From a CT of the chest to the masks and the cost map of a patient."""
