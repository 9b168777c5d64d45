"""A live session on a loopback: what goes out, what comes back, and how it bears delay, loss and nonsense."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from anatomy.poses import roll_towards
from lungaccess.plans.plan import Plan

pytest.importorskip("pyigtl", reason="pyigtl (extra `live`) is not installed")

from anatomy.io.openigtlink import HEADER_BYTES, pose_message, require_pyigtl
from lungaccess.cli import app as cli
from lungaccess.showing.live import Answer, Link, LiveSession, TrackedReplanner
from lungaccess.showing.live.replanning import NEEDLE_TIP, SCOPE_TIP, TARGET, TUBE_TIP
from stages.needle import TrueNeedle, bend_direction

ROUNDS = 400


class Peer:
    """A program at the other end."""

    def __init__(self, port: int) -> None:
        self.connection = socket.create_connection(("127.0.0.1", port))
        self.connection.settimeout(0.02)
        self._left = b""

    def send(self, name: str, pose: np.ndarray, time_s: float = 1.0) -> None:
        self.connection.sendall(pose_message(name, pose, time_s))

    def read(self) -> list[Any]:
        """Return what has come, as pyigtl reads it."""
        messages = require_pyigtl()
        try:
            self._left += self.connection.recv(1 << 20)
        except TimeoutError:
            return []
        found = []
        while len(self._left) >= HEADER_BYTES:
            fields = messages.MessageBase.parse_header(self._left[:HEADER_BYTES])
            end = HEADER_BYTES + fields["body_size"]
            if len(self._left) < end:
                break
            made = messages.MessageBase.create_message(fields["message_type"])
            made.unpack(fields, self._left[HEADER_BYTES:end])
            found.append(made)
            self._left = self._left[end:]
        return found


class Stage:
    """A session with a peer, and all answers."""

    def __init__(self, plan: Plan, lung: Lung, link: Link) -> None:
        self.answers: list[Answer] = []
        self.link = link
        self.session = LiveSession(plan, lung, link, on_answer=self.answers.append, wall_clock=lambda: 100.0)
        self.peer = Peer(link.port)
        self.received: list[Any] = []

    def until(self, count: int) -> None:
        """Go round until so many answers have been given."""
        for n in range(ROUNDS):
            self.session.tick(0.05 * n)
            self.received += self.peer.read()
            if len(self.answers) >= count:
                self.session.tick(0.0)
                self.received += self.peer.read()
                return
        raise AssertionError(f"{len(self.answers)} of {count} answers")

    def named(self, name: str) -> list[Any]:
        return [each for each in self.received if each.device_name == name]


@pytest.fixture
def stage(small_plan: Plan, breathing_lung: Lung) -> Iterator[Stage]:
    with Link(port=0) as link:
        made = Stage(small_plan, breathing_lung, link)
        yield made
        made.peer.connection.close()


def test_poses_paths_and_phases_go_out(stage: Stage, small_plan: Plan) -> None:
    for elapsed in (0.0, 0.05, 1e6):
        stage.session.tick(elapsed)
        stage.received += stage.peer.read()
    for _ in range(ROUNDS):
        if len(stage.named("Phase")) >= 3:
            break
        stage.session._link.poll(0.005)
        stage.received += stage.peer.read()
    ras = np.array([-1.0, -1.0, 1.0])
    path = np.array(stage.named("NeedlePath")[0].positions)
    assert np.abs(path[-1] * ras - small_plan.end_lps).max() < 1e-4
    assert {each.device_name for each in stage.received} >= {
        "ScopeTip", "TubeTip", "NeedleTip", "ScopePath", "TubePath", "Stage", "Phase", "BreathingDevices",
    }  # fmt: skip
    last = stage.named("NeedleTip")[-1].matrix
    assert np.abs(last[:3, 3] * ras - small_plan.end_lps).max() < 1e-4
    assert stage.named("Stage")[-1].string.startswith("needle")
    assert 0.0 <= float(stage.named("Phase")[-1].string) <= 1.0


@pytest.mark.parametrize(
    ("name", "paths"),
    [(SCOPE_TIP, {"TubePath", "NeedlePath"}), (TUBE_TIP, {"NeedlePath"}), (NEEDLE_TIP, {"NeedlePath"})],
)
def test_a_tracked_pose_is_planned_from(name: str, paths: set[str], stage: Stage, small_plan: Plan) -> None:
    pose = small_plan.scope.lps_from_scope_tip if name == SCOPE_TIP else small_plan.tube.lps_from_tip
    stage.until(0)
    stage.received.clear()
    stage.peer.send(name, np.asarray(pose))
    stage.until(1)
    (answer,) = stage.answers
    assert answer.found and answer.words.startswith("plan"), answer.words
    for _ in range(20):
        stage.received += stage.peer.read()
    assert stage.named("Replan")[0].string.startswith(f"{name}: plan")
    assert {
        each.device_name for each in stage.received if each.device_name in ("TubePath", "NeedlePath")
    } == paths
    end = np.array(stage.named("NeedlePath")[-1].positions)[-1] * [-1.0, -1.0, 1.0]
    assert np.linalg.norm(end - small_plan.end_lps) < 1.5
    assert stage.session.counts.replans == 1


def test_late_poses_that_come_at_once_are_answered_once(stage: Stage, small_plan: Plan) -> None:
    """A network that holds poses back and lets them go together: only the newest counts."""
    stage.until(0)
    for n in range(5):
        pose = np.array(small_plan.tube.lps_from_tip)
        pose[2, 3] += 0.01 * n
        stage.peer.send(TUBE_TIP, pose, float(n))
    stage.until(1)
    for _ in range(5):
        stage.session.tick(0.0)
    counts = stage.session.counts
    assert counts.replans + counts.superseded == 5 and counts.superseded >= 1


def test_a_session_survives_its_peer(stage: Stage, small_plan: Plan) -> None:
    """The connection is lost in the middle of a message; the next one gets paths and answers as ever."""
    stage.until(0)
    stage.peer.connection.sendall(pose_message(TUBE_TIP, np.asarray(small_plan.tube.lps_from_tip), 1.0)[:80])
    stage.peer.connection.close()
    for _ in range(20):
        stage.session.tick(0.0)
    stage.peer = Peer(stage.link.port)
    stage.received.clear()
    stage.peer.send(TUBE_TIP, np.asarray(small_plan.tube.lps_from_tip))
    stage.until(1)
    for _ in range(20):
        stage.received += stage.peer.read()
    assert stage.answers[0].found and stage.named("ScopePath") and stage.named("Replan")
    assert stage.session.counts.link.joined == 2


def test_nonsense_is_answered_in_words_or_counted(stage: Stage, small_plan: Plan) -> None:
    far = np.eye(4)
    far[:3, 3] = 1e4
    outside = np.array(small_plan.tube.lps_from_tip)
    outside[:3, 3] += 80.0
    stage.until(0)
    poses = ((SCOPE_TIP, far), (TUBE_TIP, far), (NEEDLE_TIP, far), (TARGET, far), (TUBE_TIP, outside))
    for n, (name, pose) in enumerate(poses, start=1):
        stage.peer.send(name, pose)
        stage.until(n)
    stage.peer.send("Nobody", np.eye(4))
    for _ in range(ROUNDS):
        stage.session.tick(0.0)
        if stage.session.counts.unknown:
            break
    counts = stage.session.counts
    assert counts.unknown == 1 and counts.found == 0 and counts.replans == len(poses)
    assert all(answer.words.startswith("no plan: ") for answer in stage.answers)


def test_a_tracked_target_is_aimed_at(small_plan: Plan, breathing_lung: Lung) -> None:
    replanner = TrackedReplanner(small_plan, breathing_lung)
    moved = np.eye(4)
    moved[:3, 3] = small_plan.end_lps + [0.8, -0.4, 0.4]
    assert replanner.answer(TARGET, moved).words == "target moved"
    for name in (SCOPE_TIP, TUBE_TIP, NEEDLE_TIP):
        pose = small_plan.scope.lps_from_scope_tip if name == SCOPE_TIP else small_plan.tube.lps_from_tip
        answer = replanner.answer(name, np.asarray(pose))
        if answer.needle_lps is not None:
            assert np.linalg.norm(answer.needle_lps[-1] - moved[:3, 3]) < 1.1


class Bends(NamedTuple):
    """A needle that goes where it is told to but bends more or less."""

    factor: float

    def roll(self) -> None:
        pass

    def bend(self, frame: np.ndarray, curvature: float, inserted_mm: float) -> tuple[float, float]:
        return 0.0, self.factor * curvature

    def measure(self, needle: TrueNeedle) -> None:
        return None


@pytest.mark.parametrize("factor", [0.6, 1.6])
def test_a_tracked_needle_tells_how_much_it_bends(
    factor: float, small_plan: Plan, breathing_lung: Lung
) -> None:
    """A robot that does what the paths sent to it say, with another curvature; the target is tracked, too."""
    replanner, moved = TrackedReplanner(small_plan, breathing_lung), np.eye(4)
    moved[:3, 3] = small_plan.end_lps
    needle = TrueNeedle(Bends(factor), np.asarray(small_plan.tube.lps_from_tip), 0.0)
    words = replanner.answer(NEEDLE_TIP, needle.frame).words
    most = small_plan.system.needle.max_curvature_per_mm
    while needle.inserted_mm < 0.6 * small_plan.needle.length_mm:
        path = replanner._needle_replanner.plan
        length, roll, curvature = path.arcs[0]
        needle.roll(roll_towards(needle.frame, bend_direction(path.lps_from_start, roll)))
        needle.insert(min(0.5, length), min(curvature / replanner._belief.factor, most))
        words = replanner.answer(NEEDLE_TIP, needle.frame).words
        assert replanner.answer(TARGET, moved).words == "target moved"
    assert replanner._belief.factor == pytest.approx(factor, rel=0.25), words
    assert f"bends {replanner._belief.factor:.2f} times as told" in words


def test_the_same_poses_give_the_same_answers(small_plan: Plan, breathing_lung: Lung) -> None:
    def asked() -> list[Any]:
        replanner = TrackedReplanner(small_plan, breathing_lung)
        pose = np.array(small_plan.tube.lps_from_tip)
        pose[:3, 3] += 0.2
        return [replanner.answer(name, pose).needle_lps for name in (TUBE_TIP, NEEDLE_TIP, NEEDLE_TIP)]

    for one, other in zip(asked(), asked(), strict=True):
        assert (one is None and other is None) or np.array_equal(one, other)


@pytest.mark.parametrize("rate", [0.0, -1.0, float("nan"), 1e6])
def test_rates_have_a_range(rate: float, small_plan: Plan, breathing_lung: Lung) -> None:
    with Link(port=0) as link, pytest.raises(SettingsError, match="rate"):
        LiveSession(small_plan, breathing_lung, link, rate_hz=rate)


def test_the_command_counts_what_it_did(
    small_plan: Plan,
    breathing_lung: Lung,
    tmp_path: Any,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("lungaccess.cli.options.load_lung", lambda *_: breathing_lung)
    small_plan.save(tmp_path / "plan.json")
    words = ["stream", str(tmp_path / "plan.json"), "toy", "--port", "0", "--seconds", "0.2"]
    assert cli.main([*words, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["ticks"] >= 1 and answer["link"]["joined"] == 0
    assert cli.main(words) == 0
    assert "Listening at 127.0.0.1:" in capsys.readouterr().out
