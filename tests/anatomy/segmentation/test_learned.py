"""A network of the user's own: a tiny one is made here, run tile by tile, and its faults get plain words."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError, FileError, SettingsError
from anatomy.base.typed import Array
from anatomy.grid import Grid, Volume
from anatomy.segmentation.learned import learned_airway, read_network

WHY = "the extra lungaccess[learned] and onnx are not installed"
STEEP, CUT = 40.0, 0.37
"""The network's logit is STEEP * (CUT - value): air, 0 in its input, is airway."""


@pytest.fixture
def onnx() -> Any:
    pytest.importorskip("onnxruntime", reason=WHY)
    return pytest.importorskip("onnx", reason=WHY)


@pytest.fixture
def ct() -> Volume:
    """A tube of air along an oblique line through tissue, and a small bubble."""
    grid = Grid.from_spacing((40, 34, 28), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    i, j, k = np.indices(grid.shape)
    hu = np.full(grid.shape, 40, dtype=np.int16)
    hu[np.hypot(i - 8 - 0.8 * k, j - 12 - 0.3 * k) < 4] = -1000
    hu[34:37, 2:5, 2:5] = -1000
    return Volume(grid=grid, array=hu)


def _network(onnx: Any, path: Path, sides: tuple = ("k", "j", "i"), *, logits: bool = False) -> Path:
    """Write a network: the mean over 3 x 3 x 3 voxels, and a threshold."""
    helper, channels = onnx.helper, 2 if logits else 1
    weights = np.full((channels, 1, 3, 3, 3), -STEEP / 27.0, dtype=np.float32)
    bias = np.full(channels, STEEP * CUT, dtype=np.float32)
    if logits:
        weights[0], bias[0] = 0.0, 0.0
    conv = helper.make_node("Conv", ["ct", "w", "b"], ["logit"], pads=[1] * 6)
    last = helper.make_node("Identity" if logits else "Sigmoid", ["logit"], ["out"])
    number = onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        [conv, last],
        "tiny",
        [helper.make_tensor_value_info("ct", number, [1, 1, *sides])],
        [helper.make_tensor_value_info("out", number, [1, channels, *sides])],
        [onnx.numpy_helper.from_array(weights, "w"), onnx.numpy_helper.from_array(bias, "b")],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    onnx.save(model, str(path))
    return path


def _tube(ct: Volume) -> Array:
    tube = ct.array < -500
    tube[34:, :5, :5] = False
    return tube


@pytest.mark.parametrize(
    "settings",
    [
        "tile = [16, 12, 20]\noverlap = 0.5",
        "tile = [96, 96, 96]",
        'tile = [16, 16, 16]\naxes = "ijk"',
        "spacing_mm = [0.8, 0.8, 0.8]\ntile = [24, 24, 24]",
    ],
)
def test_the_largest_piece_is_the_airway_whatever_the_tiles(
    onnx: Any, tmp_path: Path, ct: Volume, settings: str
) -> None:
    path = _network(onnx, tmp_path / "net.onnx")
    (tmp_path / "net.toml").write_text(settings)
    network = read_network(path)
    found = learned_airway(ct, network)
    inner = (slice(2, -2),) * 3
    assert np.count_nonzero((found != _tube(ct))[inner]) < 0.15 * np.count_nonzero(_tube(ct))
    assert not found[34:, :6, :6].any()
    assert settings.split(" =")[0] in network.words and "net.onnx" in network.words


def test_tiles_give_what_the_whole_image_gives(onnx: Any, tmp_path: Path, ct: Volume) -> None:
    path = _network(onnx, tmp_path / "net.onnx")
    found = []
    for tile in ([40, 34, 28], [16, 16, 16], [20, 18, 9]):
        (tmp_path / "net.toml").write_text(f"tile = {tile}\noverlap = 0.6")
        found.append(learned_airway(ct, read_network(path)))
    assert (found[0] == found[1]).mean() > 0.999 and (found[0] == found[2]).mean() > 0.999


def test_classes_by_logits_and_a_fixed_tile(onnx: Any, tmp_path: Path, ct: Volume) -> None:
    path = _network(onnx, tmp_path / "net.onnx", (20, 18, 16), logits=True)
    (tmp_path / "net.toml").write_text('output = "logit"\nchannel = 1')
    found = learned_airway(ct, read_network(path))
    assert np.count_nonzero(found & _tube(ct)) > 0.7 * np.count_nonzero(_tube(ct))
    (tmp_path / "net.toml").write_text('output = "logit"\nchannel = 2')
    with pytest.raises(SettingsError, match="gives the shape.*channel 2"):
        learned_airway(ct, read_network(path))


def test_faults_of_a_network_get_plain_words(onnx: Any, tmp_path: Path, ct: Volume) -> None:
    path = tmp_path / "net.onnx"
    path.write_bytes(b"no network")
    with pytest.raises(SettingsError, match="net.onnx cannot be loaded"):
        learned_airway(ct, read_network(path))
    _network(onnx, path, ("j", "i"))
    with pytest.raises(SettingsError, match="cannot be loaded|takes an input of the shape"):
        learned_airway(ct, read_network(path))
    _network(onnx, path)
    (tmp_path / "net.toml").write_text("low_hu = 0.0\nhigh_hu = 1e-3\ntile = [32, 32, 32]\nthreshold = 0.999")
    solid = Volume(grid=ct.grid, array=np.full(ct.grid.shape, 40, dtype=np.int16))
    with pytest.raises(AnatomyError, match="finds no airway: its highest probability"):
        learned_airway(solid, read_network(path))


def test_settings_are_checked(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="There is no file"):
        read_network(tmp_path / "net.onnx")
    (tmp_path / "net.pt").write_bytes(b"")
    with pytest.raises(FileError, match="is no network"):
        read_network(tmp_path / "net.pt")
    path = tmp_path / "net.onnx"
    path.write_bytes(b"x")
    assert "settings by default" in read_network(path).words
    wrongs = (
        "tile = [4, 64, 64]",
        "low_hu = 500",
        "spacing_mm = [1.0]",
        'axes = "x"',
        "overlap = 1.0",
        "win = 3",
    )
    for wrong in wrongs:
        (tmp_path / "net.toml").write_text(wrong)
        with pytest.raises(SettingsError, match=wrong.split(" =")[0]):
            read_network(path)


def test_a_missing_onnxruntime_is_named(tmp_path: Path, ct: Volume, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "net.onnx"
    path.write_bytes(b"x")
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(SettingsError, match=r"pip install 'lungaccess\[learned\]'"):
        learned_airway(ct, read_network(path))
