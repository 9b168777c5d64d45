"""Advice during a procedure: the best motion from any configuration that the user is in [Rosell2012].

A path is followed, planned again when the scope leaves it, and undone where the scope is stuck.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from anatomy.base.typed import Float
from stages.scope.advisor.advisor import Advice, Advisor
from stages.scope.advisor.best_motion import Motion
from stages.scope.advisor.kinematics import ScopeState, joints
from stages.scope.advisor.path import ScopePath
from stages.scope.advisor.path_search import PathSearch

SAME_STATE_MM = 0.75
"""The scope is at a state of the plan if its base, its joints and its tip are this near, about a voxel."""


class Session:
    """Advises a person who holds the scope, call after call.

    The best motion of the moment can lead into a place from which no motion leads on.  A session therefore
    looks for the whole path and advises its next motion.  It remembers how the scope came, and knows how
    far to pull it back if it is in the wrong airway or stuck.

    Parameters
    ----------
    advisor : Advisor
        Not in reproduction: the paper advises the best motion alone.
    start : ScopeState
        Where the scope is.

    Examples
    --------
    >>> from anatomy.build import build_lung
    >>> from anatomy.phantom import make_phantom
    >>> from stages.scope.advisor import Advisor, Session, goal_at, lumen_of_lung, model_of, start_state
    >>> from stages.scope import Bronchoscope
    >>> lung = build_lung(make_phantom(seed=1, size="small").images)
    >>> scope = Bronchoscope(
    ...     name="thin", outer_diameter_mm=3.0, channel_diameter_mm=1.2,
    ...     bend_up_deg=180.0, bend_down_deg=130.0, bending_length_mm=15.0,
    ...     min_bending_radius_mm=8.0, min_shaft_radius_mm=10.0, bending_stiffness_n_mm2=420.0,
    ... )
    >>> lumen, model = lumen_of_lung(lung), model_of(scope)
    >>> start = start_state(lumen, lung.tree, model)
    >>> session = Session(Advisor(lumen, model, goal_at(lumen, lung.tree.carina_lps)), start)
    >>> session.advise(start).action
    'advance'
    """

    def __init__(self, advisor: Advisor, start: ScopeState, *, seed: int = 0) -> None:
        self._advisor = advisor
        self._search = PathSearch(advisor.environment, advisor.goal, advisor.options, seed)
        self.plan: ScopePath = self._search.run(start)
        self._at = 0
        self._return_states = np.zeros((0, 14))
        self._return_mm = np.zeros(0)

    def advise(self, state: ScopeState, *, own: Motion | None = None) -> Advice:
        """Return the advice for a state: the next motion of the plan, or how far to pull back.

        "arrived" is where the plan ends, be it the goal or the nearest point found.

        Parameters
        ----------
        state : ScopeState
            Where the scope is, in the lumen.
        own : Motion, optional
            A motion that the user is about to make, to be evaluated.

        Raises
        ------
        AnatomyError
            If the tip is not in the lumen.
        """
        advice = self._advisor.advise(state, own=own)
        if advice.action == "arrived":
            return advice
        pulled = self._pulling(state)
        if pulled is not None:
            return replace(advice, action="pull back", motion=pulled, cost=0.0)
        number = self._place(self.plan.states, state)
        if number < 0:
            pulled = self._plan_anew(state)
            if pulled is not None:
                return replace(advice, action="pull back", motion=pulled, cost=0.0)
            number = self._at
        self._at = number
        if number >= self.plan.nearest:
            return replace(advice, action="arrived", motion=None, cost=0.0)
        following = self.plan.states[number + 1]
        motion = Motion(
            advance_mm=float(self.plan.steps_mm[number + 1]),
            twist_rad=float(following[12]),
            bend_rad=float(following[13]),
        )
        return replace(advice, action="advance", motion=motion, cost=float(self.plan.costs[number + 1]))

    def _place(self, states: Float, state: ScopeState) -> int:
        """Return the state that the scope is in, -1 if in none; the last on ties."""
        if not len(states):
            return -1
        model = self._advisor.environment.model
        away = np.linalg.norm(joints(model, states) - joints(model, state.array), axis=2).max(axis=1)
        nearest = len(away) - 1 - int(np.argmin(away[::-1]))
        return nearest if away[nearest] <= SAME_STATE_MM else -1

    def _pulling(self, state: ScopeState) -> Motion | None:
        """Return how far to pull back still, if the scope is being pulled back."""
        number = self._place(self._return_states, state)
        if number < 0 or self._place(self.plan.states, state) >= 0:
            return None
        return self._back(float(self._return_mm[: number + 1].sum()))

    def _back(self, length_mm: float) -> Motion:
        target = self.plan.states[self._at]
        return Motion(advance_mm=-length_mm, twist_rad=float(target[12]), bend_rad=float(target[13]))

    def _plan_anew(self, state: ScopeState) -> Motion | None:
        """Plan from where the scope is and how it came; return how far to pull back, if that is the plan."""
        came, came_mm = self.plan.states[: self._at + 1], self.plan.steps_mm[: self._at + 1]
        step = float(np.linalg.norm(state.lps_from_base[:3, 3] - came[-1, 9:12]))
        history, steps_mm = np.vstack([came, state.array]), np.append(came_mm, step)
        self.plan = self._search.resume(history, steps_mm)
        common = min(len(history), self.plan.count)
        same = (self.plan.states[:common] == history[:common]).all(axis=1)
        kept = common if same.all() else int(np.argmin(same))
        self._at = kept - 1
        self._return_states, self._return_mm = history[kept:], steps_mm[kept:]
        return self._back(float(steps_mm[kept:].sum())) if kept < len(history) else None
