"""What a voxel of the image `state`, uint8, is while the airway grows."""

import numpy as np

FREE = np.uint8(0)
LUMEN = np.uint8(1)
BANNED = np.uint8(2)
"""Not lumen, and never to become it."""
