"""What all code stands on and that is no anatomy: errors, settings, files, caches, types, words."""
