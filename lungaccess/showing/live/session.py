"""A live session: poses, paths and phases of a plan go out, tracked poses come in and are planned from."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.io.openigtlink import Received, points_message, pose_message, text_message
from anatomy.lung import Lung
from lungaccess.planning.procedure import Policy
from lungaccess.plans.plan import Plan
from lungaccess.showing.live.link import Link, LinkCounts
from lungaccess.showing.live.replanning import TARGET, TRACKED, Answer, TrackedReplanner
from lungaccess.showing.live.trajectory import Speeds, Trajectory, plan_trajectory
from lungaccess.uncertainty.breathing.moving import Moving

RATE_HZ = 20.0
TIPS = {"ScopeTip": "scope", "TubeTip": "tubes", "NeedleTip": "needle"}
"""Names of the poses that are sent, and the stages whose tips they are."""
PATHS = ("ScopePath", "TubePath", "NeedlePath")
MOST_POINTS = 300
"""Points of a path that is sent: a message of 40 kB."""


@frozen_value
class LiveCounts:
    """What a session has done.

    Args:
        ticks, overrun: Rounds, and how many of them took longer than the rate allows.
        replans, found: Tracked poses that were planned from, and how many of them had a way.
        superseded: Tracked poses that were passed over because a newer one had come.
        unknown: Messages under names that mean nothing here.
        replan_median_ms, replan_most_ms: Processor time of a replan; 0 without one.
    """

    ticks: int
    overrun: int
    replans: int
    found: int
    superseded: int
    unknown: int
    replan_median_ms: float
    replan_most_ms: float
    link: LinkCounts


class LiveSession:
    """Sends a plan in motion and plans again from what is tracked, round by round.

    Args:
        rate_hz: Rounds a second.
        speeds: How fast the sent poses move along the plan.
        loop: Whether the motion begins again when it has ended; otherwise its end is sent on and on.
        on_answer: Gets every `Answer`.
        policy: What decides about tracked poses, see `TrackedReplanner`.
        wall_clock: Returns the time since 1970 in seconds.

    Raises:
        PlanFileError: If the plan was made for another patient.
        SettingsError: If the rate is not above 0 or above 1000.
    """

    def __init__(
        self,
        plan: Plan,
        lung: Lung,
        link: Link,
        *,
        rate_hz: float = RATE_HZ,
        speeds: Speeds | None = None,
        loop: bool = False,
        on_answer: Callable[[Answer], None] | None = None,
        policy: Policy | None = None,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        if not 0.0 < rate_hz <= 1000.0:
            raise SettingsError(f"The rate is {rate_hz} Hz", expected="above 0 and at most 1000 Hz")
        self._replanner = TrackedReplanner(plan, lung, policy)
        self._trajectory: Trajectory = plan_trajectory(plan, speeds)
        self._moving = None if lung.motion is None else Moving.of(plan, lung)
        self._plan, self._link, self._rate_hz, self._loop = plan, link, rate_hz, loop
        self._on_answer = on_answer or (lambda _answer: None)
        self._wall_clock = wall_clock
        self._counts: Counter[str] = Counter()
        self._replan_s: list[float] = []
        scope, tubes, needle = (curve.points_lps for curve in plan.curves(1.0))
        self._paths: dict[str, Float] = dict(zip(PATHS, (scope, tubes, needle), strict=True))
        self._greet()

    @property
    def counts(self) -> LiveCounts:
        """What has been done so far."""
        taken = 1e3 * np.array(self._replan_s or [0.0])
        return LiveCounts(
            **{name: self._counts[name] for name in ("ticks", "overrun", "found", "superseded", "unknown")},
            replans=len(self._replan_s), replan_median_ms=float(np.median(taken)),
            replan_most_ms=float(taken.max()), link=self._link.counts,
        )  # fmt: skip

    def run(self, seconds: float | None = None) -> None:
        """Go round until so many seconds have passed, or for ever."""
        self._replanner.warm_up()
        began = due = time.monotonic()
        while seconds is None or time.monotonic() - began < seconds:
            self.tick(time.monotonic() - began)
            due += 1.0 / self._rate_hz
            if time.monotonic() > due:
                self._counts["overrun"] += 1
                due = time.monotonic()
            # What comes until the next round is due is answered meanwhile.
            while (left := due - time.monotonic()) > 0.0:
                self._take(self._link.poll(left))

    def tick(self, elapsed_s: float) -> None:
        """Do one round: answer what has come, and send where everything is after so many seconds."""
        self._counts["ticks"] += 1
        self._take(self._link.poll())
        self._link.send(*self._state(elapsed_s))

    def _take(self, received: list[Received]) -> None:
        """Answer the newest of each tracked pose."""
        newest: dict[str, Float] = {}
        for each in received:
            if each.name not in (*TRACKED, TARGET) or each.lps_from_device is None:
                self._counts["unknown"] += 1
                continue
            self._counts["superseded"] += each.name in newest
            newest[each.name] = each.lps_from_device
        for name in sorted(newest, key=(TARGET, *TRACKED).index):
            answer = self._replanner.answer(name, newest[name])
            self._replan_s.append(answer.processor_s)
            self._counts["found"] += answer.found
            self._send(answer)
            self._on_answer(answer)

    def _send(self, answer: Answer) -> None:
        """Send what came of a tracked pose."""
        now = self._wall_clock()
        taken = f"{1e3 * answer.processor_s:.1f} ms"
        messages = [text_message("Replan", f"{answer.name}: {answer.words} ({taken})", now)]
        for name, points in (("TubePath", answer.tubes_lps), ("NeedlePath", answer.needle_lps)):
            if points is not None:
                self._paths[name] = points
                messages.append(_path_message(name, points, now))
        self._link.send(*messages)
        self._greet()

    def _greet(self) -> None:
        """Let everyone who connects get the paths as they are now."""
        now = self._wall_clock()
        self._link.greet_with(
            tuple(_path_message(name, points, now) for name, points in self._paths.items() if len(points))
        )

    def _state(self, elapsed_s: float) -> list[bytes]:
        """Return the messages that say where everything is."""
        now, moves = self._wall_clock(), self._trajectory
        last = float(moves.time_s[-1])
        at_s = elapsed_s % last if self._loop and last > 0.0 else min(elapsed_s, last)
        row = int(np.searchsorted(moves.time_s, at_s))
        stage = moves.stages[row]
        messages = [pose_message(name, moves.tips(device)[row], now) for name, device in TIPS.items()]
        messages.append(text_message("Stage", f"{stage} {at_s:.1f} of {last:.1f} s", now))
        if self._moving is not None:
            # One breath, out and in, takes 4 s [assumption].
            phase = 0.5 - 0.5 * np.cos(2.0 * np.pi * elapsed_s / 4.0)
            messages.append(text_message("Phase", f"{phase:.3f}", now))
            messages.append(pose_message("BreathingDevices", self._moving.pose(float(phase)), now))
        return messages


def _path_message(name: str, points: Float, time_s: float) -> bytes:
    every = -(-len(points) // MOST_POINTS)
    chosen = np.vstack([points[:-1:every], points[-1:]])
    return points_message(name, chosen, [f"{n}" for n in range(1, len(chosen) + 1)], time_s)
