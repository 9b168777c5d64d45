"""A synthetic patient with known truth: airways, vessels, lobes, nodules and CT from a seed."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from anatomy.phantom.branching import Centerlines
    from anatomy.phantom.chest import LOBES
    from anatomy.phantom.files import write_phantom
    from anatomy.phantom.patient import Phantom, make_phantom
    from anatomy.phantom.rasterize import LABELS
    from anatomy.phantom.territory import Nodule

__getattr__, __dir__ = lazy_exports(__name__, __file__)
