"""The bronchoscope advisor [Rosell2012]: motions from wherever the scope is, and paths to a goal."""
