"""The action server `plan_access`: `ros2 run lungaccess_ros server`."""

from __future__ import annotations

from typing import Any

import rclpy
from lungaccess_msgs.action import PlanAccess
from rclpy.action import ActionServer
from rclpy.node import Node
from rosidl_runtime_py import set_message_fields

from lungaccess_ros.answers import answer


class PlanServer(Node):
    """Plans one goal after the other, and tells the cost of each better plan meanwhile."""

    def __init__(self) -> None:
        super().__init__("lungaccess")
        self._server = ActionServer(self, PlanAccess, "plan_access", self._execute)

    def _execute(self, handle: Any) -> Any:
        def tell(cost: float) -> None:
            handle.publish_feedback(PlanAccess.Feedback(cost=cost))

        result = PlanAccess.Result()
        set_message_fields(result, answer(handle.request, tell))
        handle.succeed()
        return result


def main() -> None:
    """Serve until the node is stopped."""
    rclpy.init()
    node = PlanServer()
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()
