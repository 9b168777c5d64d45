"""One example for every command: help and error messages show it.

The examples work as they stand, in this order, in an empty folder: each uses what those before it wrote.
"""

from collections.abc import Mapping

EXAMPLES: Mapping[str, str] = {
    "demo": "lungaccess demo --out demo-output",
    "phantom": "lungaccess phantom --out PATIENT --breathing",
    "info": "lungaccess info PATIENT --out info",
    "presets": "lungaccess presets --show ultrathin",
    "template": "lungaccess template study --out study.toml",
    "plan": "lungaccess plan PATIENT --nodule --budget 5 --out plan",
    "check": "lungaccess check plan/plan.json PATIENT",
    "report": "lungaccess report plan/plan.json PATIENT",
    "view": "lungaccess view PATIENT --no-browser",
    "steps": "lungaccess steps plan/plan.json PATIENT",
    "risk": "lungaccess risk plan/plan.json PATIENT --samples 2000",
    "window": "lungaccess window plan/plan.json PATIENT",
    "start-region": "lungaccess start-region plan/plan.json PATIENT",
    "export": "lungaccess export plan/plan.json PATIENT --slicer slicer",
    "stream": "lungaccess stream plan/plan.json PATIENT --port 0 --seconds 2",
    "insert": "lungaccess insert plan/plan.json PATIENT --samples 5 --film insert.webp",
    "alternatives": "lungaccess alternatives PATIENT --nodule --count 5 --out plans",
    "needle": "lungaccess needle PATIENT --start plan/plan.json --nodule",
    "replan": "lungaccess replan PATIENT --scope plan/plan.json --nodule",
    "advise": "lungaccess advise PATIENT --nodule --lesion-radius 8",
    "certify": "lungaccess certify PATIENT --nodule --system ultrathin --most-boxes 100000",
    "tour": "lungaccess tour PATIENT --no-require-plan --out tour",
    "route": "lungaccess route PATIENT --goal lps:22.9,9,-23.9 --curvature 0.1 --tolerance 5",
    "tubes": "lungaccess tubes --outer 10 --inner 40 --out tubes.png",
    "shapes": "lungaccess shapes --system ultrathin --out shapes.csv",
    "reach": "lungaccess reach PATIENT --spacing 10 --out reach",
    "segment": "lungaccess segment PATIENT/ct.nii.gz --out SEGMENTED",
    "design": "lungaccess design --out design",
    "study run": "lungaccess study run study.toml --out results.db",
    "study show": "lungaccess study show results.db",
    "study export": "lungaccess study export results.db --csv tables",
    "study compare": "lungaccess study compare results.db results.db",
    "benchmark med-rad": "lungaccess benchmark med-rad PATIENT --seeds 1 --budget 0.2 --out runs.csv",
    "benchmark synthetic-v1 make": (
        "lungaccess benchmark synthetic-v1 make --phantoms child-01 --out SYNTHETIC"
    ),
    "benchmark synthetic-v1 run": (
        "lungaccess benchmark synthetic-v1 run SYNTHETIC --targets 2 --devices ultrathin "
        "--out synthetic.db --answers answers"
    ),
    "benchmark synthetic-v1 score": (
        "lungaccess benchmark synthetic-v1 score answers/atlas.json SYNTHETIC --out scores.json"
    ),
    "benchmark synthetic-v1 sheet": "lungaccess benchmark synthetic-v1 sheet scores.json",
    "benchmark synthetic-v1 schema": "lungaccess benchmark synthetic-v1 schema",
    "cache": "lungaccess cache",
    "cache prune": "lungaccess cache prune --older-than 30 --max-size 5GB",
    "cache clear": "lungaccess cache clear --cache CACHE",
    "doctor": "lungaccess doctor",
    "selftest": "lungaccess selftest",
    "completion": "lungaccess completion bash",
}
"""A command line for each command."""

EXAMPLE_OF_ALL = f"Example: {EXAMPLES['demo']}"
EXIT_CODES = (
    "Exit codes: 0 done, any plan made is accepted by the check; 1 the answer is no; 2 bad input; 70 a crash."
)

START_PAGE = """\
lungaccess plans the access to a lung nodule: bronchoscope, concentric tubes, steerable needle.

Without data:
  lungaccess demo                             a synthetic patient, a plan, its pictures and a page
  lungaccess phantom --out PATIENT            the folder of a synthetic patient, to try commands on

With a patient, which is a folder of masks:
  lungaccess segment CT --out PATIENT         makes one of a CT
  lungaccess info PATIENT                     what was understood of it
  lungaccess plan PATIENT --nodule            a plan to its largest nodule
  lungaccess report lungaccess-plan/plan.json PATIENT

lungaccess --help lists all commands; each explains itself, as in: lungaccess plan --help
"""
"""`lungaccess` prints this if it is given no command."""


def epilogue(command: str) -> str:
    """Return what ends the help of a command: its example, and the exit codes."""
    return f"Example: {EXAMPLES[command]}\n\n{EXIT_CODES}"
