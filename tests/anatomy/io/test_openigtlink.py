"""Messages of OpenIGTLink: frames on the wire, and bytes that are damaged."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from anatomy.base.errors import FileError, SettingsError

messages = pytest.importorskip("pyigtl.messages", reason="pyigtl (extra `live`) is not installed")

from anatomy.io.openigtlink import (  # noqa: E402
    CHECKSUM,
    DAMAGED,
    HEADER_BYTES,
    NOT_RIGID,
    OTHER_KIND,
    Decoder,
    points_message,
    pose_message,
    text_message,
)

LEFT = np.array([60.0, -20.0, 30.0])
"""A point on the patient's left, LPS mm."""


def pose_at(place: np.ndarray = LEFT, angle: float = 0.7) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(angle * np.array([0.6, 0.0, 0.8])).as_matrix()
    pose[:3, 3] = place
    return pose


def other_reader(data: bytes) -> object:
    """Return a message as pyigtl reads it."""
    fields = messages.MessageBase.parse_header(data[:HEADER_BYTES])
    made = messages.MessageBase.create_message(fields["message_type"])
    made.unpack(fields, data[HEADER_BYTES:])
    return made


def test_poses_are_ras_on_the_wire() -> None:
    """What is on the patient's left has a negative R, as 3D Slicer shows it."""
    found = other_reader(pose_message("Tip", pose_at(), 5.25))
    assert found.device_name == "Tip" and found.timestamp == pytest.approx(5.25)  # type: ignore[attr-defined]
    assert np.allclose(found.matrix[:3, 3], [-60.0, 20.0, 30.0])  # type: ignore[attr-defined]
    assert np.linalg.det(found.matrix[:3, :3]) == pytest.approx(1.0, abs=1e-5)  # type: ignore[attr-defined]


def test_points_are_ras_on_the_wire() -> None:
    found = other_reader(points_message("Path", np.stack([LEFT, 2.0 * LEFT]), ["1", "2"], 1.0))
    assert np.allclose(found.positions, [[-60.0, 20.0, 30.0], [-120.0, 40.0, 60.0]])  # type: ignore[attr-defined]
    assert found.names == ["1", "2"]  # type: ignore[attr-defined]


def test_texts_are_ascii() -> None:
    assert other_reader(text_message("Stage", "5° further", 1.0)).string == "5? further"  # type: ignore[attr-defined]


@given(st.lists(st.integers(1, 40), min_size=1, max_size=30), st.floats(-3.0, 3.0))
@settings(max_examples=20, deadline=None)
def test_what_is_sent_is_read_in_any_pieces(sizes: list[int], angle: float) -> None:
    pose = pose_at(angle=angle)
    data = pose_message("A", pose, 1.0) + text_message("B", "hello", 2.0) + pose_message("C", pose, 3.0)
    decoder, found, at = Decoder(), [], 0
    for size in (*sizes, len(data)):
        found += decoder.feed(data[at : at + size])
        at += size
    assert [each.name for each in found] == ["A", "B", "C"]
    assert found[1].text == "hello"
    for each in (found[0], found[2]):
        assert np.abs(each.lps_from_device - pose).max() < 1e-5
        assert np.abs(each.lps_from_device[:3, :3].T @ each.lps_from_device[:3, :3] - np.eye(3)).max() < 1e-12
    assert not decoder.dropped


def test_what_cannot_be_used_is_dropped_and_counted() -> None:
    decoder, good = Decoder(), pose_message("A", pose_at(), 1.0)
    wrong = bytearray(good)
    wrong[HEADER_BYTES + 3] ^= 1
    mirrored = pose_message("A", pose_at() @ np.diag([-1.0, 1.0, 1.0, 1.0]), 1.0)
    scaled = pose_message("A", pose_at() * 1.5, 1.0)
    infinite = _with_body(good, good[HEADER_BYTES:-12] + struct.pack("> f f f", np.inf, 0.0, 0.0))
    other = points_message("P", LEFT[None], ["1"], 1.0)
    short = _with_body(good, good[HEADER_BYTES:-8])
    named = bytearray(good)
    named[14:18] = b"\xff\xfe\xff\xfe"
    data = b"".join([bytes(wrong), mirrored, scaled, infinite, other, short, bytes(named), good])
    found = list(decoder.feed(data))
    assert [each.name for each in found] == ["A"]
    assert decoder.dropped == {CHECKSUM: 1, NOT_RIGID: 3, OTHER_KIND: 1, DAMAGED: 2}


def _with_body(message: bytes, body: bytes) -> bytes:
    """Return a message with another body, whose size and checksum are right."""
    sizes = struct.pack("> Q Q", len(body), messages.CRC64(body))
    return message[: HEADER_BYTES - 16] + sizes + body


@given(st.binary(max_size=400), st.integers(0, 105), st.integers(0, 255))
@settings(max_examples=60, deadline=None)
def test_damaged_bytes_never_raise_anything_else(noise: bytes, place: int, value: int) -> None:
    good = bytearray(pose_message("A", pose_at(), 1.0))
    good[place] = value
    for data in (noise, bytes(good) + noise, noise + bytes(good)):
        try:
            list(Decoder().feed(data))
        except FileError as error:
            assert "OpenIGTLink" in str(error)


def test_a_message_of_absurd_size_ends_the_stream() -> None:
    good = bytearray(pose_message("A", pose_at(), 1.0))
    good[42:50] = struct.pack("> Q", 1 << 40)
    with pytest.raises(FileError, match="claims"):
        list(Decoder().feed(bytes(good)))


@pytest.mark.parametrize("name", ["", "a name that is too long"])
def test_names_are_short(name: str) -> None:
    with pytest.raises(SettingsError, match="name"):
        pose_message(name, pose_at(), 1.0)
