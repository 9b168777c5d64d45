"""Describe a device of your own.

A device is a TOML file with the unit in every key; an unknown key or an impossible value is an error that
names it. The picture compares the cost of the plans of this device, whose needle bends tightly, with that
of a preset.
"""

from pathlib import Path

import matplotlib.pyplot as plt

import lungaccess as la

lung = la.load_patient("phantom-3")
target = la.resolve_target(lung, nodule=1)
figure, ax = plt.subplots(figsize=(6, 4))
for device in ["ultrathin", Path(__file__).with_name("my_device.toml")]:
    system = la.load_system(device)
    atlas = la.open_atlas(lung, system)  # what scope and tubes can do; it is kept
    plans = la.plan(lung, system, target, atlas=atlas, iterations=100, goal="default")
    costs = [plan.costs["inverse_clearance"] for plan in plans]
    radius_mm = 1.0 / system.needle.max_curvature_per_mm
    ax.plot(costs, "o-", label=f"{system.name}: needle radius {radius_mm:.0f} mm")
ax.set(xlabel="number of the plan", ylabel="integral of 1 / clearance", title="Two needles, one nodule")
ax.legend()
figure.savefig("device.png")
