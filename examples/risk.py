"""How likely a plan succeeds.

The devices of a stored plan deviate at random: scope, tubes and needle, by errors of stated size. The
bars show the share of procedures that would succeed if there were errors of one kind only, with 95 %
confidence intervals.
"""

import matplotlib.pyplot as plt

import lungaccess as la
from lungaccess.uncertainty.risk import assess

lung = la.load_patient("phantom-3")
plan = la.Plan.load("plan.json")
report = assess(plan, lung, samples=2000, seed=0)
print(f"success with all errors: {report.succeeds.value:.1%} of {report.samples}")

shares = {"all errors": report.succeeds, **report.alone}
figure, ax = plt.subplots(figsize=(8, 4.5))
for row, (_kind, share) in enumerate(shares.items()):
    low, high = share.interval
    ax.barh(row, 100 * share.value, color="C1" if row == 0 else "C0")
    ax.plot([100 * low, 100 * high], [row, row], color="black")
ax.set_yticks(range(len(shares)), shares)
ax.set(xlabel="success, %", title=f"Within {report.radius_mm:.1f} mm, nothing forbidden touched")
figure.tight_layout()
figure.savefig("risk.png")
