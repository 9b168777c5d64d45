"""A network of the user's own in place of the growth of the airway: ONNX, tile by tile, on the processor."""

from __future__ import annotations

import itertools
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from anatomy.base.errors import AnatomyError, FileError, SettingsError
from anatomy.base.files import read_toml, sha256
from anatomy.base.records import frozen_value
from anatomy.base.settings import impossible, parse, quantity, settings
from anatomy.base.typed import Array, Float, Float32, Mask
from anatomy.grid import Volume
from anatomy.morphology import largest_piece

SUFFIX = ".onnx"
MOST_TILE = 512
"""A tile of a whole chest at 1 mm; the network holds many numbers for each of its voxels."""
EXTRA = "learned"
"""The extra of the package that brings onnxruntime."""


@settings
class NetworkSettings:
    """How a network wants its CT; what is left out takes the default."""

    spacing_mm: Annotated[
        tuple[float, ...],
        Field(description="Voxel size it was trained on: right-left, front-back, feet-head; or the CT's"),
    ] = ()
    tile: Annotated[tuple[int, int, int], Field(description="Voxels of a tile, in that order")] = (96, 96, 96)
    overlap: Annotated[
        float, quantity("Share of a tile that lies in the next one", at_least=0.0, below=1.0)
    ] = 0.25
    low_hu: Annotated[float, quantity("This and less becomes 0")] = -1000.0
    high_hu: Annotated[float, quantity("This and more becomes 1")] = 400.0
    axes: Annotated[
        Literal["kji", "ijk"], Field(description="Order of the axes of the input; i runs right to left")
    ] = "kji"
    output: Annotated[
        Literal["probability", "logit"], Field(description="What the network gives for each class")
    ] = "probability"
    channel: Annotated[int, Field(description="Class of the airway, from 0; -1 is the last", ge=-1)] = -1
    threshold: Annotated[float, quantity("From this probability on it is airway", above=0.0, below=1.0)] = 0.5

    def __post_init__(self) -> None:
        if len(self.spacing_mm) not in (0, 3) or any(not 0.1 <= s <= 5.0 for s in self.spacing_mm):
            raise impossible("spacing_mm", self.spacing_mm, "three numbers from 0.1 to 5, or none")
        if not all(8 <= n <= MOST_TILE for n in self.tile):
            raise impossible("tile", self.tile, f"three numbers from 8 to {MOST_TILE}")
        if self.low_hu >= self.high_hu:
            raise impossible("low_hu", self.low_hu, f"less than high_hu, {self.high_hu:g}")


@frozen_value
class Network:
    """A file of a network, its settings, what both contain, and how to name it."""

    path: Path
    settings: NetworkSettings
    digest: str
    words: str


def read_network(path: Path) -> Network:
    """Read the settings of a network from the TOML file of the same name beside it, if there is one.

    Raises FileError or SettingsError if there is no such file, or its settings are wrong.
    """
    if path.suffix != SUFFIX or not path.is_file():
        raise FileError(
            f"{path} is no network" if path.is_file() else f"There is no file {path}",
            expected=f"a network as a file that ends with {SUFFIX}",
            remedy="Export it with torch.onnx.export, or check the name",
        )
    beside, content, digest = path.with_suffix(".toml"), {}, sha256(path)
    if beside.is_file():
        content = read_toml(beside, expected="lines such as low_hu = -1000", remedy="Correct it")
        digest += sha256(beside)
    chosen = parse(NetworkSettings, content, beside.name)
    stated = "; ".join(f"{key} {value}" for key, value in content.items()) or "settings by default"
    return Network(path=path, settings=chosen, digest=digest, words=f"the network {path.name} ({stated})")


def learned_airway(ct: Volume, network: Network) -> Mask:
    """Return the largest piece of what a network takes for airway, `(ni, nj, nk)`.

    The CT has Hounsfield units, in the order of voxels of `canonical`.  Raises SettingsError if onnxruntime
    is missing, or the network does not take a CT, and AnatomyError if it finds no airway.
    """
    how = network.settings
    scaled = (ct.array.astype(np.float32) - np.float32(how.low_hu)) / np.float32(how.high_hu - how.low_hu)
    image = np.clip(scaled, 0.0, 1.0, out=scaled)
    wanted = np.array(how.spacing_mm) if how.spacing_mm else ct.grid.spacing_mm
    share = _tiled(_Runner(network), _resampled(image, wanted / ct.grid.spacing_mm), how)
    if share.shape != image.shape:
        share = _resampled(share, ct.grid.spacing_mm / wanted, image.shape)
    found = largest_piece(np.asfortranarray(share >= how.threshold))
    if not found.any():
        raise AnatomyError(
            f"{network.path.name} finds no airway: its highest probability is {float(share.max()):.2f}",
            expected=f"probabilities of {how.threshold:g} and more",
            remedy=f"Check its settings in {network.path.with_suffix('.toml').name}: HU, axes, channel",
        )
    return found


def _resampled(image: Float32, step: Float, shape: tuple[int, ...] | None = None) -> Float32:
    """Return an image linearly at voxels `step` times as large over the same box."""
    from scipy.ndimage import affine_transform

    if shape is None:
        if np.allclose(step, 1.0):
            return image
        shape = tuple(max(1, round(n / s)) for n, s in zip(image.shape, step, strict=True))
    made = affine_transform(
        image, step, offset=0.5 * (step - 1.0), output_shape=shape, order=1, mode="nearest"
    )
    return np.asarray(made, dtype=np.float32)


def _tiled(run: _Runner, image: Float32, how: NetworkSettings) -> Float32:
    """Return the probabilities of an image: tiles that overlap count less towards their edges."""
    tile = run.tile
    padded = np.pad(image, [(0, int(n)) for n in np.maximum(np.array(tile) - image.shape, 0)], mode="edge")
    total, weights = np.zeros(padded.shape, dtype=np.float32), np.zeros(padded.shape, dtype=np.float32)
    window = np.ones((1, 1, 1), dtype=np.float32)
    for axis, n in enumerate(tile):
        slope = 1.0 - np.abs(np.arange(n) - 0.5 * (n - 1)) / (0.5 * (n + 1))
        window = window * slope.astype(np.float32).reshape([-1 if a == axis else 1 for a in range(3)])
    starts = []
    for n, t in zip(padded.shape, tile, strict=True):
        count = 1 + int(np.ceil((n - t) / max(1.0, t * (1.0 - how.overlap))))
        starts.append(sorted({round(at) for at in np.linspace(0, n - t, count)}))
    for start in itertools.product(*starts):
        box = tuple(slice(a, a + n) for a, n in zip(start, tile, strict=True))
        total[box] += window * run(padded[box])
        weights[box] += window
    return np.asarray((total / weights)[tuple(slice(0, n) for n in image.shape)])


class _Runner:
    """A network that is ready to run on one tile."""

    def __init__(self, network: Network) -> None:
        try:
            runtime = import_module("onnxruntime")
        except ImportError as error:
            raise SettingsError(
                f"{network.path.name} needs onnxruntime, which is not installed",
                expected=f"the package with its extra {EXTRA}",
                remedy=f"pip install 'lungaccess[{EXTRA}]', or leave out --onnx-airway",
            ) from error
        self._how, self._name = network.settings, network.path.name
        options = runtime.SessionOptions()
        options.use_deterministic_compute = True
        options.log_severity_level = 3
        try:
            self._session: Any = runtime.InferenceSession(
                str(network.path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # its exceptions have no common base of their own
            raise self._refused("cannot be loaded", error) from error
        entry = self._session.get_inputs()[0]
        self._input = entry.name
        if len(entry.shape) != 5:
            raise SettingsError(
                f"{self._name} takes an input of the shape {entry.shape}",
                expected="five axes: one image, one channel, and three of a volume",
                remedy="Export the network for volumes",
            )
        sides = entry.shape[2:] if self._how.axes == "ijk" else entry.shape[:1:-1]
        self.tile = tuple(
            int(n) if isinstance(n, int) else t for n, t in zip(sides, self._how.tile, strict=True)
        )

    def __call__(self, tile: Float32) -> Float32:
        ordered = tile if self._how.axes == "ijk" else tile.T
        try:
            out: Array = self._session.run(None, {self._input: np.ascontiguousarray(ordered[None, None])})[0]
        except Exception as error:
            raise self._refused("cannot be run", error) from error
        if out.ndim != 5 or out.shape[2:] != ordered.shape or self._how.channel >= out.shape[1]:
            raise SettingsError(
                f"{self._name} gives the shape {list(out.shape)} for a tile of {list(ordered.shape)}",
                expected=f"one image with channel {self._how.channel} and the shape of the tile",
                remedy="Set channel and tile in the TOML file beside the network",
            )
        share: Float32 = self._shares(out[0].astype(np.float32))[self._how.channel]
        return share if self._how.axes == "ijk" else share.T

    def _shares(self, out: Float32) -> Float32:
        if self._how.output == "probability":
            return out
        if len(out) == 1:
            return np.asarray(1.0 / (1.0 + np.exp(-np.clip(out, -60.0, 60.0))), dtype=np.float32)
        raised = np.exp(out - out.max(axis=0, keepdims=True))
        return np.asarray(raised / raised.sum(axis=0, keepdims=True), dtype=np.float32)

    def _refused(self, what: str, error: Exception) -> SettingsError:
        return SettingsError(
            f"{self._name} {what}: {str(error).splitlines()[0][:200]}",
            expected="a network that onnxruntime runs on the processor",
            remedy="Export it again, or set its tile in the TOML file beside it",
        )
