"""What a person sees of a plan: pages, pictures, scenes, and what a tracker is told."""
