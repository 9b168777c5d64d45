"""Compiled kernels of the segmentation."""
