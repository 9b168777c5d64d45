"""From a synthetic CT to the anatomy, and what compiling the kernels costs."""

from __future__ import annotations

import time

from anatomy.phantom import make_phantom
from anatomy.segmentation.airway import segment_airway
from anatomy.segmentation.lungs import segment_lungs
from anatomy.segmentation.vessels import segment_vessels
from benchmarks.fresh import FreshProcess

COLD_RUN = """
from benchmarks.bench_segmentation import Segmentation
work = Segmentation()
work.setup()
"""


class Segmentation:
    """The steps of the segmentation on a small patient; CPU time of all threads."""

    timeout = 300
    timer = time.process_time

    def setup(self) -> None:
        """Make the CT, and compile."""
        self.ct = make_phantom(seed=3, size="small").ct
        self.lungs = segment_lungs(self.ct)
        self.airways = segment_airway(self.ct, self.lungs)
        self.time_vessels()

    def time_lungs(self) -> None:
        """Both lungs."""
        segment_lungs(self.ct)

    def time_airway(self) -> None:
        """Lumen and wall."""
        segment_airway(self.ct, self.lungs)

    def time_vessels(self) -> None:
        """Vesselness and vessels."""
        segment_vessels(self.ct, self.lungs.left | self.lungs.right, self.airways)


class Compile(FreshProcess):
    """All kernels of the segmentation in a new process, without and with cached ones."""

    code = COLD_RUN

    def time_segmentation(self, cold: bool) -> None:
        """Each step once."""
        self.run()
