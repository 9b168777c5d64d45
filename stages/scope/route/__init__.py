"""Routes for a curvature-limited device along any tree of tubes with radii [Li2021]."""
