"""Load a patient.

A patient is a folder of masks. This one is synthetic: it is drawn from a seed and written to a folder, as
a segmentation of a CT would be. The picture shows the airway tree that was found in the mask of the
lumen.
"""

import lungaccess as la
from anatomy.phantom import make_phantom, write_phantom
from lungaccess.showing.report import tree_png

write_phantom(make_phantom(seed=3, size="small"), "phantom-3")
lung = la.load_patient("phantom-3")
print(f"{lung.name}: {lung.tree.n_branches} branches, {lung.grid.shape} voxels")

tree_png(lung, "patient.png")
