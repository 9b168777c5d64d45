"""Tube systems with known answers."""

from __future__ import annotations

import math

import numpy as np

from stages.scope.route.centreline import Centreline


def chain(points: np.ndarray, radius: float) -> Centreline:
    """One tube of even width along a polyline."""
    index = np.arange(len(points) - 1)
    return Centreline(
        nodes_mm=points, radius_mm=np.full(len(points), radius), edges=np.stack((index, index + 1), axis=1)
    )


def straight(length: float = 60.0, radius: float = 3.0, spacing: float = 0.5) -> Centreline:
    z = np.linspace(0.0, length, round(length / spacing) + 1)
    return chain(np.stack((np.zeros_like(z), np.zeros_like(z), z), axis=1), radius)


def corner(angle_deg: float, radius: float, leg: float = 40.0, spacing: float = 0.5) -> Centreline:
    """Two straight legs that meet at a sharp corner, in a plane that no axis lies in."""
    along = np.linspace(0.0, leg, round(leg / spacing) + 1)
    turn = math.radians(angle_deg)
    first = np.stack((along - leg, np.zeros_like(along), np.zeros_like(along)), axis=1)
    second = np.stack((along * math.cos(turn), along * math.sin(turn), np.zeros_like(along)), axis=1)
    rotation = np.linalg.qr(np.array(((1.0, 2.0, 0.5), (0.3, 1.0, -1.0), (0.7, -0.4, 1.0))))[0]
    return chain(np.vstack((first, second[1:])) @ rotation.T, radius)


def least_clearance_of_corner(angle_deg: float, curvature: float) -> float:
    """How far an arc of this curvature, tangent to both legs, passes from the corner."""
    half = math.radians(angle_deg) / 2
    return (1.0 / math.cos(half) - 1.0) / curvature


def fork(radius: float = 2.0, spacing: float = 0.5) -> Centreline:
    """A trunk along z that divides into two branches at 30 degrees to either side."""
    count = round(30.0 / spacing)
    along = np.arange(1, count + 1)[:, None] * spacing
    trunk = np.array([0.0, 0.0, 1.0]) * np.arange(count + 1)[:, None] * spacing
    nodes, edges = [trunk], [np.stack((np.arange(count), np.arange(1, count + 1)), axis=1)]
    for sign in (1.0, -1.0):
        direction = np.array((sign * 0.5, 0.0, math.sqrt(0.75)))
        base = sum(len(part) for part in nodes)
        nodes.append(trunk[-1] + along * direction)
        chain_of = np.concatenate(((count,), np.arange(base, base + count)))
        edges.append(np.stack((chain_of[:-1], chain_of[1:]), axis=1))
    points = np.vstack(nodes)
    return Centreline(nodes_mm=points, radius_mm=np.full(len(points), radius), edges=np.vstack(edges))
