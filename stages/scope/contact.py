"""What is known of the contact between a bronchoscope's shaft and the wall of the airway, as ranges."""

from typing import Annotated

from anatomy.base.settings import quantity, settings, text


@settings
class WallContact:
    """How the wall yields, how the shaft slides on it, and what it may bear.

    `docs/explanation/resting_scope.md` says where the defaults come from.

    Parameters
    ----------
    wall_stiffness_n_per_mm2 : float
        Force on a mm of the shaft's length that presses the wall in by a mm.  Mucosa of 0.02 to 0.28 MPa
        [Wang2011] yields by about as much as a bed of that modulus.
    wall_stiffness_range, scope_stiffness_range : float
        Factors by which the stiffness of wall and scope may be less or more.
    max_friction : float
        Largest coefficient of friction; the least is 0.
    max_wall_force_n : float
        Largest force on 10 mm of wall.
    max_wall_give_mm : float
        How far the wall may be pressed in; it is then twice as hard as at first, as soft tissue stiffens.
    source : str
        Where the numbers come from; what nobody has published begins with "assumption".
    """

    wall_stiffness_n_per_mm2: Annotated[
        float, quantity("force on a mm of length that presses the wall in by a mm", above=0.0, at_most=100.0)
    ] = 0.1
    wall_stiffness_range: Annotated[
        float, quantity("factor by which the wall may be softer or stiffer", at_least=1.0, at_most=100.0)
    ] = 3.0
    scope_stiffness_range: Annotated[
        float, quantity("factor by which the scope may be softer or stiffer", at_least=1.0, at_most=100.0)
    ] = 2.0
    max_friction: Annotated[
        float, quantity("largest coefficient of friction on the wall", at_least=0.0, at_most=2.0)
    ] = 0.2
    max_wall_force_n: Annotated[
        float, quantity("largest force on 10 mm of wall", above=0.0, at_most=100.0)
    ] = 1.0
    max_wall_give_mm: Annotated[
        float, quantity("how far the wall may be pressed in", above=0.0, at_most=10.0)
    ] = 1.0
    source: Annotated[str, text("where the numbers come from, or a text that begins with 'assumption'")] = (
        "assumption"
    )
