"""The ROS 2 package: its action is understood, and what the server answers are messages."""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ET
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan

typesys: Any = pytest.importorskip("rosbags.typesys")
ROS = Path(__file__).parents[4] / "packaging" / "ros"
ACTION = ROS / "lungaccess_msgs" / "action" / "PlanAccess.action"


@pytest.fixture(scope="module")
def store() -> Any:
    """Return the types of ROS 2 with the three parts of the action."""
    made = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    for name, text in zip(("Goal", "Result", "Feedback"), ACTION.read_text().split("---\n"), strict=True):
        made.register(typesys.get_types_from_msg(text, f"lungaccess_msgs/msg/{name}"))
    return made


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch, small_lung: Lung) -> ModuleType:
    file = ROS / "lungaccess_ros" / "lungaccess_ros" / "answers.py"
    spec = importlib.util.spec_from_file_location("lungaccess_ros_answers", file)
    assert spec is not None and spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    monkeypatch.setattr(made.la, "load_patient", lambda _folder: small_lung)
    return made


def message(store: Any, kind: str, values: dict[str, Any]) -> Any:
    """Return a message of plain values, as `rosidl_runtime_py.set_message_fields` fills it."""
    fields = store.fielddefs[kind][1]
    made = {name: _field(store, sort, about, values.get(name)) for name, (sort, about) in fields}
    assert set(values) <= set(made), set(values) - set(made)
    return store.types[kind](**made)


def _field(store: Any, sort: Any, about: Any, value: Any) -> Any:
    if sort.name == "BASE":
        return ("" if about[0] == "string" else 0) if value is None else value
    if sort.name == "NAME":
        return message(store, about, value or {})
    (inner, kind), _length = about
    if inner.name == "NAME":
        return [message(store, kind, each) for each in value or ()]
    return list(value or ()) if kind[0] == "string" else np.array(value or [], dtype=kind[0])


def goal(plan: Plan, **changes: Any) -> SimpleNamespace:
    x, y, z = (1e-3 * plan.target_lps).tolist()
    asked = {
        "patient": "p",
        "target": SimpleNamespace(x=x, y=y, z=z),
        "system": plan.system.name,
        "budget_s": 2.0,
    }
    return SimpleNamespace(**asked | changes)


def test_an_answer_is_a_message_that_goes_over_the_wire(
    store: Any, answers: ModuleType, small_plan: Plan, small_lung: Lung
) -> None:
    costs: list[float] = []
    found = answers.answer(goal(small_plan), costs.append)
    assert found["accepted"]
    kind = "lungaccess_msgs/msg/Result"
    sent = store.serialize_cdr(message(store, kind, found), kind)
    received = store.deserialize_cdr(sent, kind)
    plan = Plan.from_json(received.plan)
    assert la.check(plan, small_lung).accepted
    assert costs[-1] == plan.cost
    last = received.needle.poses[-1].pose.position
    np.testing.assert_allclose(1e3 * np.array([last.x, last.y, last.z]), plan.end_lps, atol=1e-6)
    assert received.joints.joint_names[0] == "scope_advance"
    assert len(received.joints.points) > 10 and 0.0 <= received.success <= 1.0


def test_a_refusal_is_an_answer(store: Any, answers: ModuleType, small_plan: Plan) -> None:
    found = answers.answer(goal(small_plan, system="no-such-device"))
    assert not found["found"] and "no-such-device" in found["text"] and found["success"] == -1.0
    kind = "lungaccess_msgs/msg/Result"
    received = store.deserialize_cdr(store.serialize_cdr(message(store, kind, found), kind), kind)
    assert received.plan == "" and not received.joints.points
    outside = goal(small_plan, target=SimpleNamespace(x=9.0, y=0.0, z=0.0))
    assert not answers.answer(outside)["found"]


def test_packages_name_what_they_need() -> None:
    for package in ("lungaccess_msgs", "lungaccess_ros"):
        root = ET.parse(ROS / package / "package.xml").getroot()
        assert root.findtext("name") == package
    needed = {
        each.text for each in ET.parse(ROS / "lungaccess_msgs" / "package.xml").getroot().iter("depend")
    }
    used = {line.split("/")[0] for line in ACTION.read_text().splitlines() if "_msgs/" in line.split(" ")[0]}
    assert used <= needed
    assert "PlanAccess.action" in (ROS / "lungaccess_msgs" / "CMakeLists.txt").read_text()
