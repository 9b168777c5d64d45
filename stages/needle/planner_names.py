"""The names of all planners of the needle: the one list that functions, studies and the command line read."""

OUR_PLANNERS = ("rrt", "ao-rrt", "optimal", "resolution", "decide")
"""Searches of the needle stage; `stages.needle.search.planners.searches` makes them."""
OMPL_PLANNERS = ("control.RRT", "control.EST", "control.KPIECE1")
"""Planners of OMPL itself.  They steer by chance and look at no objective."""
NEEDLE_PLANNERS = (*OUR_PLANNERS, *OMPL_PLANNERS)
PLUGINS = "lungaccess.needle_planners"
"""The group of entry points by which packages add planners, whose names are known, too."""
OMPL_TOLERANCE_MM = 1.0
"""Distance to the target that counts as reached by OMPL's planners alone: they hardly ever come nearer."""
