"""Label maps of the structures of a lung, with and without names in the header."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np

from anatomy.grid import Volume

LABELS = {1: "lung_airways", 2: "lung_airways_wall", 3: "lung_arteries", 4: "lung_veins"}


def require_same(volume: Volume | None, *parts: Volume) -> None:
    assert volume is not None
    assert (volume.array == np.logical_or.reduce([part.array for part in parts])).all()


def label_map(masks: dict[str, Volume]) -> Volume:
    array = np.zeros(masks["lumen"].array.shape, dtype=np.uint8)
    for value, key in ((1, "lumen"), (2, "wall"), (3, "arteries"), (4, "veins")):
        array[masks[key].array] = value
    return Volume(grid=masks["lumen"].grid, array=array)


def add_label_table(path: Path, names: dict[int, str]) -> None:
    """Put a label table into the extension of a NIfTI header."""
    content = gzip.decompress(path.read_bytes())
    rows = "".join(f'<Label Key="{key}" Red="1"><![CDATA[{name}]]></Label>' for key, name in names.items())
    xml = (
        '<?xml version="1.0" encoding="UTF-8"?> <CaretExtension><VolumeInformation Index="0"><LabelTable>'
        f"{rows}</LabelTable></VolumeInformation></CaretExtension>\n   "
    ).encode()
    xml += b"\0" * (-(len(xml) + 8) % 16)
    block = b"\1\0\0\0" + struct.pack("<2i", len(xml) + 8, 0) + xml
    header = bytearray(content[:348])
    header[108:112] = struct.pack("<f", 348 + len(block))
    path.write_bytes(gzip.compress(bytes(header) + block + content[352:]))
