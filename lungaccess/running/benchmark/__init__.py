"""Published needle queries run with our planners and OMPL's, by our rules or those of a peer."""
