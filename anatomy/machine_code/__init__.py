"""Machine code of kernels: what it was compiled from, where it is kept, and how it is made ahead of use."""
