"""The explorer: a local page on which a target is clicked and its plans are seen at once."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.showing.explorer.questions import WhatIf
    from lungaccess.showing.explorer.server import Address, Explorer
    from lungaccess.showing.explorer.worker import PatientSource

__getattr__, __dir__ = lazy_exports(__name__, __file__)
