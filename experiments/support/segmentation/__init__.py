"""CTs rendered with known truth, and scores of their segmentation."""
