"""What all code of the project stands on and that is no anatomy: errors, settings, files, caches, types, words."""
