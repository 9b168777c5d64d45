"""Eigenvalues, Hessians and vesselness against what is known in closed form."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from anatomy.base.errors import AnatomyError, GridMismatchError
from anatomy.segmentation.kernels.eigenvalues import eigenvalues
from anatomy.segmentation.vessels import SIGMAS_MM, ScaleSpace, discrete_gaussian, vesselness
from tests.anatomy.segmentation.shapes import distance_to_surface

LUNG_HU, BLOOD_HU = -860.0, 40.0


def by_magnitude(matrices: np.ndarray) -> np.ndarray:
    # LAPACK loses half its digits where the square of an entry underflows; so small a one changes nothing.
    negligible = np.abs(matrices) < 1e-30 * np.abs(matrices).max(axis=(1, 2), keepdims=True)
    values = np.linalg.eigvalsh(np.where(negligible, 0.0, matrices))
    return np.take_along_axis(values, np.argsort(np.abs(values), axis=1), axis=1)


@numba.njit
def compiled(xx, yy, zz, xy, xz, yz):  # type: ignore[no-untyped-def]
    return eigenvalues(xx, yy, zz, xy, xz, yz)


def closed_form(matrices: np.ndarray) -> np.ndarray:
    rows = matrices.astype(np.float64)
    return np.array([compiled(m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2]) for m in rows])


def require_equal_eigenvalues(matrices: np.ndarray) -> None:
    got, expected = closed_form(matrices), by_magnitude(matrices)
    size = np.abs(matrices).max(axis=(1, 2))[:, None]
    # Eigenvalues of nearly equal magnitude may swap places: compare them in order of value.
    assert (np.abs(np.sort(got, axis=1) - np.sort(expected, axis=1)) <= 1e-7 * size).all()
    assert (np.diff(np.abs(got), axis=1) >= 0.0).all()


class TestEigenvalues:
    def test_an_entry_whose_square_underflows(self) -> None:
        m = np.array([[[0.0, 1e-157, 0.0], [1e-157, 0.0, 53.0], [0.0, 53.0, 0.0]]])
        assert closed_form(m)[0] == pytest.approx([0.0, -53.0, 53.0], abs=1e-12)

    @given(arrays(np.float64, (20, 6), elements=st.floats(-1e4, 1e4)))
    @settings(max_examples=60, deadline=None)
    def test_any(self, entries: np.ndarray) -> None:
        m = np.zeros((20, 3, 3))
        rows, columns = np.triu_indices(3)
        m[:, rows, columns] = entries
        m[:, columns, rows] = entries
        require_equal_eigenvalues(m)

    @given(
        arrays(np.float64, (10, 4), elements=st.floats(-1.0, 1.0)),
        st.sampled_from(
            [(1.0, 1.0, 1.0), (-5.0, -5.0, 0.0), (2.0, 2.0, -2.0), (1.0, 1.0, 1.0 + 1e-9), (0.0, 0.0, -3.0)]
        ),
        st.sampled_from([1e-30, 1e-6, 1.0, 1e6, 1e30]),
    )
    @settings(max_examples=60, deadline=None)
    def test_equal_and_tiny(self, quaternions: np.ndarray, values: tuple[float, ...], scale: float) -> None:
        q = quaternions + np.array([2.0, 0.0, 0.0, 0.0])
        w, x, y, z = (q / np.linalg.norm(q, axis=1)[:, None]).T
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        ).transpose(2, 0, 1)
        m = scale * turn @ np.diag(values) @ turn.transpose(0, 2, 1)
        require_equal_eigenvalues(0.5 * (m + m.transpose(0, 2, 1)))

    def test_zero(self) -> None:
        assert (closed_form(np.zeros((1, 3, 3))) == 0.0).all()


class TestScaleSpace:
    @pytest.mark.parametrize("variance", [0.01, 0.4, 2.0, 16.0, 40.0])
    def test_kernel_has_its_variance(self, variance: float) -> None:
        weights = discrete_gaussian(variance).astype(np.float64)
        n = np.arange(len(weights))
        assert weights[0] + 2.0 * weights[1:].sum() == pytest.approx(1.0, abs=1e-6)
        assert 2.0 * (weights * n**2).sum() == pytest.approx(variance, rel=4e-3)

    @pytest.mark.parametrize("spacing", [(0.7, 0.7, 0.7), (0.55, 0.7, 1.0)])
    def test_gaussian_blob_has_the_analytic_hessian(self, spacing: tuple[float, float, float]) -> None:
        """A blob of variance s^2 becomes one of s^2 + sigma^2: trace of the scaled Hessian at its centre."""
        h, s, contrast = np.array(spacing), 2.0, 900.0
        shape = tuple(int(2 * round(24 / a) + 1) for a in h)
        axes = [(np.arange(n) - n // 2) * a for n, a in zip(shape, h, strict=True)]
        x, y, z = np.meshgrid(*axes, indexing="ij")
        blob = (contrast * np.exp(-(x**2 + y**2 + z**2) / (2 * s**2))).astype(np.float32)
        space = ScaleSpace.of(blob, np.ones(shape, dtype=bool), h)
        i, j, k = (n // 2 for n in shape)
        for sigma, image in space.images():
            f = space.hessian_factors(sigma)
            twice = 2.0 * float(image[k, j, i])
            second = (
                f[0] * (image[k, j, i - 1] + image[k, j, i + 1] - twice),
                f[1] * (image[k, j - 1, i] + image[k, j + 1, i] - twice),
                f[2] * (image[k - 1, j, i] + image[k + 1, j, i] - twice),
            )
            variance = s**2 + sigma**2
            expected = -(sigma**2) * contrast * (s**2 / variance) ** 1.5 / variance
            # A second difference over h is a second derivative smoothed by h^2 / 6 more.
            assert second == pytest.approx([expected] * 3, rel=0.06)


def cylinder(
    radius_mm: float,
    spacing: tuple[float, float, float] = (0.7, 0.7, 0.7),
    hu: float = BLOOD_HU,
    kind: str = "cylinder",
) -> tuple[np.ndarray, np.ndarray]:
    """Return the HU of a shape in lung tissue, and the distance to its surface (negative inside)."""
    distance = distance_to_surface(kind, radius_mm, spacing, 40.0)
    share = np.clip(0.5 - distance / 1.2, 0.0, 1.0)
    return (LUNG_HU + (hu - LUNG_HU) * share).astype(np.float32), distance


MIDDLE = np.s_[18:-18, 18:-18, 18:-18]


class TestVesselness:
    @pytest.mark.parametrize("hu", [40.0, 350.0])
    @pytest.mark.parametrize("radius_mm", [0.75, 1.0, 1.5, 2.0, 3.0])
    def test_cylinders_answer_within_and_not_around(self, radius_mm: float, hu: float) -> None:
        image, away = cylinder(radius_mm, hu=hu)
        found = vesselness(image, np.ones(image.shape, dtype=bool), (0.7, 0.7, 0.7))[MIDDLE]
        away = away[MIDDLE]
        assert found[away < -0.6 * radius_mm].min() > 0.5
        assert found[away > max(2.0, 1.5 * radius_mm)].max() < 0.25

    def test_plates_and_balls_answer_less_than_cylinders(self) -> None:
        response = {}
        for kind in ("cylinder", "plate", "ball"):
            image, away = cylinder(1.5, kind=kind)
            found = vesselness(image, np.ones(image.shape, dtype=bool), (0.7, 0.7, 0.7))[MIDDLE]
            response[kind] = float(np.median(found[away[MIDDLE] < -0.75]))
        assert response["plate"] < 0.05
        assert response["ball"] < 0.6 * response["cylinder"]

    def test_dark_tubes_do_not_answer(self) -> None:
        image, _ = cylinder(1.5, hu=-1000.0)
        found = vesselness(image, np.ones(image.shape, dtype=bool), (0.7, 0.7, 0.7))[MIDDLE]
        assert found.max() < 0.05

    @pytest.mark.parametrize(
        "axes",
        [
            (1, 2, 0),
            pytest.param((1, 0, 2), marks=pytest.mark.slow),
            pytest.param((2, 1, 0), marks=pytest.mark.slow),
        ],
    )
    def test_axes_may_be_permuted(self, axes: tuple[int, int, int]) -> None:
        spacing = (0.7, 0.8, 1.2)
        image, _ = cylinder(1.2, spacing)
        lung = np.ones(image.shape, dtype=bool)
        lung[:5], lung[:, -7:] = False, False
        turned = vesselness(image.transpose(axes), lung.transpose(axes), [spacing[a] for a in axes])
        assert turned == pytest.approx(vesselness(image, lung, spacing).transpose(axes), abs=2e-4)

    @pytest.mark.parametrize("axis", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 2))])
    def test_a_mirrored_image_gives_the_mirrored_response(self, axis: int) -> None:
        image, _ = cylinder(1.2, (0.7, 0.8, 1.2))
        lung = np.ones(image.shape, dtype=bool)
        lung[:5] = False
        whole = vesselness(image, lung, (0.7, 0.8, 1.2))
        mirrored = vesselness(np.flip(image, axis), np.flip(lung, axis), (0.7, 0.8, 1.2))
        assert np.flip(mirrored, axis) == pytest.approx(whole, abs=2e-6)

    def test_any_number_of_threads_gives_the_same_bits(self) -> None:
        rng = np.random.default_rng(0)
        image = (LUNG_HU + 60 * rng.standard_normal((61, 43, 37))).astype(np.int16)
        lung = rng.random(image.shape) < 0.8
        one = vesselness(image, lung, (0.7, 0.7, 1.0), threads=1)
        for threads in (2, 3, 7):
            assert (vesselness(image, lung, (0.7, 0.7, 1.0), threads=threads) == one).all()
        assert one.max() > 0.01

    def test_a_part_of_the_image_gives_what_the_whole_gives(self) -> None:
        image, _ = cylinder(1.5)
        lung = np.zeros(image.shape, dtype=bool)
        lung[22:35, 22:35, 20:37] = True
        whole = vesselness(image, lung, (0.7, 0.7, 0.7))
        reach = math.ceil(3.0 * SIGMAS_MM[-1] / 0.7)
        part = np.s_[22 - reach : 35 + reach, 22 - reach : 35 + reach, 20 - reach : 37 + reach]
        assert (vesselness(image[part], lung[part], (0.7, 0.7, 0.7)) == whole[part]).all()
        assert whole[part].max() > 0.5

    def test_memory_order_and_type_do_not_matter(self) -> None:
        image, _ = cylinder(1.5)
        whole = np.rint(image).astype(np.int16)
        lung = np.ones(image.shape, dtype=bool)
        first = vesselness(np.asfortranarray(whole), lung, (0.7, 0.7, 0.7))
        assert (vesselness(np.ascontiguousarray(whole), lung, (0.7, 0.7, 0.7)) == first).all()
        assert (vesselness(whole.astype(np.float32), lung, (0.7, 0.7, 0.7)) == first).all()

    def test_fewer_scales_near_the_surface(self) -> None:
        """Depths of eq. 4: 1 scale up to 1 mm, 3 up to 2 mm, 4 up to 2 sqrt(2) mm, then 5."""
        lung = np.zeros((30, 30, 30), dtype=bool)
        lung[5:25, 5:25, 5:25] = True
        space = ScaleSpace.of(np.zeros(lung.shape, dtype=np.int16), lung, (0.9, 0.9, 0.9))
        start = [5 - s.start for s in space.box]
        middle = space.n_scales[start[2] + 10, start[1] + 10, start[0] - 1 : start[0] + 5]
        assert middle.tolist() == [0, 1, 3, 4, 5, 5]

    def test_outside_the_lung_is_nothing(self) -> None:
        image, _ = cylinder(1.5)
        lung = np.zeros(image.shape, dtype=bool)
        lung[20:30, 20:30, 20:30] = True
        found = vesselness(image, lung, (0.7, 0.7, 0.7))
        assert (found[~lung] == 0.0).all() and found.shape == image.shape and found.dtype == np.float32

    def test_refuses_what_is_no_ct(self) -> None:
        image = np.zeros((4, 4, 4), dtype=np.int16)
        with pytest.raises(GridMismatchError, match="shape"):
            vesselness(image, np.ones((4, 4, 5), dtype=bool), (1, 1, 1))
        with pytest.raises(AnatomyError, match="empty"):
            vesselness(image, np.zeros((4, 4, 4), dtype=bool), (1, 1, 1))
        with pytest.raises(AnatomyError, match="type"):
            vesselness(image.astype(complex), np.ones((4, 4, 4), dtype=bool), (1, 1, 1))
