"""Whether the scope fits, against exact distances to voxel boxes, and eq. 1 joint by joint."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.kernels.field import MIN_GAP_MM
from anatomy.lung import Lung
from stages.scope.advisor.environment import ScopeEnvironment
from stages.scope.advisor.kinematics import ScopeModel, ScopeState, joints
from stages.scope.advisor.lumen import Lumen
from stages.scope.advisor.nf1 import navigation_field
from tests.stages.scope.airways import tube, wall_mm


def chain_points(model: ScopeModel, state: np.ndarray, per_link: int = 40) -> np.ndarray:
    corners = joints(model, state)[0]
    share = np.linspace(0.0, 1.0, per_link)[:, None]
    return np.concatenate([a + share * (b - a) for a, b in zip(corners[:-1], corners[1:], strict=True)])


def random_states(lumen: Lumen, model: ScopeModel, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return states whose base looks roughly down, anywhere in the lumen."""
    states = []
    for voxel in rng.integers(0, lumen.count, count):
        frame = np.eye(4)
        tilt = rng.uniform(-0.6, 0.6, 2)
        rotation = np.array([[1, 0, tilt[0]], [0, 1, tilt[1]], [-tilt[0], -tilt[1], 1.0]])
        frame[:3, :3] = np.linalg.qr(rotation)[0]
        frame[:3, :3] *= np.sign(np.diag(frame[:3, :3]))
        frame[:3, 3] = lumen.centres(voxel) + rng.uniform(-0.3, 0.3, 3)
        twist, bend = rng.uniform(-3, 3), rng.uniform(-1.5, 2.0)
        states.append(ScopeState(lps_from_base=frame, twist_rad=twist, bend_rad=bend).array)
    return np.array(states)


@pytest.mark.parametrize("radius", [2.6, *(pytest.param(r, marks=pytest.mark.slow) for r in (0.6, 1.0, 1.7))])
def test_the_true_radius_is_kept_along_every_link(forked: tuple[Lung, Lumen], radius: float) -> None:
    """What fits keeps its radius from every box; what does not fit lacks it, but for the least gap."""
    _lung, lumen = forked
    model = ScopeModel(radius_mm=radius)
    environment = ScopeEnvironment(model=model, field=navigation_field(lumen, 0))
    states = random_states(lumen, model, np.random.default_rng(7), 400)
    fits = environment.fits(states)
    chains = np.array([chain_points(model, state) for state in states])
    nearest = wall_mm(lumen, chains.reshape(-1, 3)).reshape(len(chains), -1).min(axis=1)
    assert (nearest[fits] >= radius).all()
    assert (nearest[~fits] < radius + MIN_GAP_MM + 1e-9).all()
    assert fits.sum() > 10, "some must fit, or nothing was tested"
    assert (~fits).sum() > 20


def test_equation_1_looks_at_the_joints_alone(forked: tuple[Lung, Lumen]) -> None:
    _lung, lumen = forked
    model = ScopeModel()
    environment = ScopeEnvironment(
        model=model, field=navigation_field(lumen, 0, metric="voxels"), reproduction=True
    )
    states = random_states(lumen, model, np.random.default_rng(3), 300)
    limit = model.link_mm / lumen.grid.spacing_mm.max()
    fits, distances = environment.fits(states), environment.distances(states)
    for n, points in enumerate(joints(model, states)):
        voxels = [lumen.voxel_at(point) for point in points]
        clearances = np.array([lumen.steps_to_wall[v] if v >= 0 else 0.0 for v in voxels])
        assert fits[n] == (clearances > limit).all()
        assert distances[n] == clearances.sum() + clearances[0]
    assert 20 < fits.sum() < 280


def test_equation_1_lets_a_scope_touch_the_wall() -> None:
    """Two voxels of L1 clearance are 1 mm of Euclidean distance or less where the wall is slanted."""
    lumen, _tree = tube(2.0, 30.0, 0.5)
    model = ScopeModel(link_mm=0.9, radius_mm=0.9)
    field = navigation_field(lumen, 0, metric="voxels")
    printed, strict = (
        ScopeEnvironment(model=model, field=field, reproduction=True),
        ScopeEnvironment(model=model, field=field),
    )
    touching = 0
    for angle in np.linspace(0.0, 2.0 * math.pi, 40, endpoint=False):
        for away in np.linspace(0.6, 1.2, 7):
            frame = np.eye(4)
            frame[:3, 3] = away * math.cos(angle), away * math.sin(angle), -5.0
            state = ScopeState(lps_from_base=frame).array
            allowed = bool(printed.fits(state)[0]) and not bool(strict.fits(state)[0])
            touching += allowed
            if allowed:
                assert wall_mm(lumen, chain_points(model, state)).min() < 0.9 + MIN_GAP_MM
    assert touching > 0


def test_nothing_fits_beyond_the_grid(forked: tuple[Lung, Lumen]) -> None:
    _lung, lumen = forked
    environment = ScopeEnvironment(model=ScopeModel(), field=navigation_field(lumen, 0))
    frame = np.eye(4)
    frame[:3, 3] = 1e4, 0.0, 0.0
    assert not environment.fits(ScopeState(lps_from_base=frame).array)[0]
    assert environment.distances(ScopeState(lps_from_base=frame).array)[0] == 0.0
