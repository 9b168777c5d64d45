"""HTML of the page about breathing: the sentence of the window, its clock, and the slider of the phase."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lungaccess.judging.appraisal.grade import Grade
from lungaccess.showing.report.clock import PROVED, limit_names, on_rim, sectors
from lungaccess.showing.report.html import words
from lungaccess.showing.report.html.breathing import SAMPLES

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.plans.plan import Plan
    from lungaccess.plans.window import BreathingWindow

NO_WINDOW = (
    "The patient breathes, but the plan has no window: in which phases it is clear was not computed. "
    "lungaccess window computes it."
)


def window_headline(plan: Plan, lung: Lung, accepted: bool) -> str:
    """Return the sentence of the window with its clock for the top of the page; "" without a motion."""
    if lung.motion is None:
        return ""
    window = plan.window
    if window is None:
        grade, said, clock = Grade.UNKNOWN, NO_WINDOW, ""
    else:
        grade, said, clock = grade_of_window(window, accepted), window.words, clock_svg(window, accepted)
        if not accepted:
            said = f"The check refuses this plan; its window is not confirmed. {said}"
    source = "" if window is None else f"<p class='note'>Motion: {words.text(window.motion_source)}.</p>"
    return (
        f'<div class="headline breath grade-{grade.key}">{clock}<div><p>'
        f'<span class="mark">{grade.mark}</span> <strong>Breathing.</strong> {words.text(said)}</p>'
        f"{source}</div></div>"
    )


def grade_of_window(window: BreathingWindow, accepted: bool) -> Grade:
    """Return how good the news of a window is: a model of other people's lungs promises nothing."""
    if not accepted or not len(window.phases):
        return Grade.POOR
    return Grade.UNKNOWN if window.warning_only else Grade.GOOD


def clock_svg(window: BreathingWindow, accepted: bool) -> str:
    """Return the window on the clock of a breath; the page turns the hand "clock-hand"."""
    middle, radius = (100.0, 92.0), 62.0

    def at(phase: float, exhaling: bool = False, share: float = 1.0) -> str:
        x, y = on_rim(phase, exhaling=exhaling, radius=share * radius)
        return f"{middle[0] + x:.1f} {middle[1] - y:.1f}"

    parts = []
    for each in sectors(window):
        colour = _colour(window, accepted, each.proved)
        for exhaling in (False, True):
            arc = f"A{radius:.0f} {radius:.0f} 0 0 {0 if exhaling else 1} {at(each.end, exhaling)}"
            look = f'fill="none" stroke="{colour}" stroke-width="15"'
            parts.append(f'<path d="M{at(each.begin, exhaling)}{arc}" {look}/>')
    for phase, name in limit_names(window):
        x, y = at(phase, share=1.24).split()
        parts.append(f'<path d="M{at(phase, share=0.84)}L{at(phase, share=1.16)}" class="axis"/>')
        parts.append(f'<text x="{x}" y="{float(y) + 4:.1f}">{words.text(name)}</text>')
    for height, said in ((14, "end-exhale, 0 %"), (182, "end-inhale, 100 %")):
        parts.append(f'<text x="100" y="{height}" text-anchor="middle">{said}</text>')
    for aside, said in ((114, "in"), (84, "out")):
        parts.append(f'<text x="{aside}" y="96" text-anchor="middle" class="faint">{said}</text>')
    hand = f"M{at(window.masks_phase, share=0.45)}L{at(window.masks_phase, share=0.85)}"
    parts.append(f'<path id="clock-hand" d="{hand}" class="cursor"/>')
    return (
        f'<svg class="clock" viewBox="25 0 265 190" role="img" aria-label="{words.text(window.words)}">'
        f"{''.join(parts)}</svg>"
    )


def _colour(window: BreathingWindow, accepted: bool, proved: bool) -> str:
    """Return the colour of a stretch: green only where it is proved for this patient, and accepted."""
    if not proved:
        return "var(--shut)"
    return PROVED if accepted and not window.warning_only else "var(--fair)"


def player(window: BreathingWindow | None, accepted: bool) -> str:
    """Return the controls of the phase, with the window marked on the slider; "" without one."""
    if window is None:
        return ""
    stops = ", ".join(
        f"{_colour(window, accepted, each.proved)} {100 * each.begin:.1f}% {100 * each.end:.1f}%"
        for each in sectors(window)
    )
    return (
        '\n    <div class="breath-row" role="group" aria-label="Breathing">'
        '<button type="button" id="breathe">Breathe</button>'
        f'<span class="track" style="--stretches: linear-gradient(90deg, {stops})">'
        '<input type="range" id="phase" min="0" max="1000" step="1" '
        f'value="{round(1000 * window.masks_phase)}" aria-label="Phase of the breath"></span>'
        '<output id="phase-words" for="phase"></output></div>'
    )


def chart(window: BreathingWindow | None) -> str:
    """Return the figure of what is to spare over the breath; "" without a window."""
    if window is None:
        return ""
    return (
        '\n      <figure id="chart-breath"><figcaption>To spare over the breath: clearance of tubes and '
        "needle beyond what is required, and tolerance of the end "
        f"(0: none left; at {SAMPLES} phases; shaded: the window)</figcaption></figure>"
    )


def slices_note(window: BreathingWindow | None) -> str:
    """Return what the slices do with the phase."""
    if window is None:
        return ""
    return (
        " They breathe with the slider of the phase; beyond the pleura the motion is continued, and ribs do "
        "not move so."
    )
