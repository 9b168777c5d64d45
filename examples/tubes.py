"""Shape of two concentric tubes.

The mechanics computes the equilibrium of nested precurved tubes, torsion included. Here the straight
outer tube is inserted further and further over the curved inner one, which straightens the part where
they overlap.
"""

import matplotlib.pyplot as plt
import numpy as np

import lungaccess as la
from stages.tube import TubeMechanics

tubes = la.load_system("lung-default").tubes
mechanics = TubeMechanics([tubes.inner, tubes.outer])  # the innermost first
along_mm = np.linspace(0.0, 35.0, 100)  # 0 is the tip of the scope
figure, ax = plt.subplots(figsize=(7, 4))
for outer_mm in [0.0, 10.0, 20.0, 30.0]:
    rear_ends_mm = [35.0 - tubes.inner.length_mm, outer_mm - tubes.outer.length_mm]
    shape = mechanics.given_base_angles([0.0, 0.0], rear_ends_mm)
    _x, y, z = shape.backbone(along_mm).T
    ax.plot(z, -y, label=f"outer tube {outer_mm:.0f} mm, inner tube 35 mm")
    print(f"outer tube {outer_mm:.0f} mm: stable {shape.stable}")
ax.set(xlabel="along the scope, mm", ylabel="aside, mm", aspect="equal", title="Centreline of the tubes")
ax.legend()
figure.savefig("tubes.png")
