"""Messages of OpenIGTLink [Tokuda2009]: poses, points and texts to bytes and back; RAS on the wire.

3D Slicer takes the numbers of a message for RAS, so they are flipped here.  The bytes are made and read by
pyigtl (extra `live`); what is damaged is dropped and counted.
"""

import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from anatomy.base.errors import FileError, SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import ORTHONORMAL_TOLERANCE
from anatomy.io.frames import LPS_FROM_RAS

HEADER_BYTES = 58
LARGEST_BYTES = 1 << 20
"""A body that claims to be larger is not what a tracker sends: the stream is damaged."""
DAMAGED, OTHER_KIND, NOT_RIGID, CHECKSUM = "damaged", "of another kind", "not a rigid pose", "wrong checksum"
"""Why a message is dropped."""
KINDS = ("TRANSFORM", "STRING")
"""What is read; other kinds are passed over."""


@frozen_record
class Received:
    """A message that was read: the pose `(4, 4)` LPS mm of a TRANSFORM, or the text of a STRING.

    It has the name of the device that it is of, and the seconds since 1970 by the sender's clock when it was
    sent, 0 if it did not say.
    """

    name: str
    time_s: float
    lps_from_device: Float | None = None
    text: str = ""


def require_pyigtl() -> Any:
    """Return the module that makes and reads messages; SettingsError if pyigtl is not installed."""
    try:
        from pyigtl import messages
    except ImportError as error:
        raise SettingsError(
            "pyigtl is not installed, which makes and reads messages of OpenIGTLink",
            expected="the extra `live`",
            remedy="pip install 'lungaccess[live]'",
        ) from error
    return messages


def pose_message(name: str, lps_from_device: Float, time_s: float) -> bytes:
    """Return a TRANSFORM: a pose `(4, 4)` LPS mm of a device of a name of at most 20 letters."""
    return _packed("TransformMessage", name, time_s, LPS_FROM_RAS @ lps_from_device)


def points_message(name: str, points_lps: Float, labels: Sequence[str], time_s: float) -> bytes:
    """Return a POINT: points `(N, 3)` LPS mm, N at least 1, with a label each."""
    points = points_lps @ LPS_FROM_RAS[:3, :3].T
    return _packed("PointMessage", name, time_s, points, names=[_ascii(label) for label in labels])


def text_message(name: str, text: str, time_s: float) -> bytes:
    """Return a STRING; letters beyond ASCII become question marks."""
    return _packed("StringMessage", name, time_s, _ascii(text))


def _ascii(text: str) -> str:
    return text.encode("ascii", "replace").decode("ascii")


def _packed(kind: str, name: str, time_s: float, content: Any, **others: Any) -> bytes:
    device = _ascii(name)
    if not 0 < len(device) <= 20:
        raise SettingsError(f"The device name {name!r} is too long or empty", expected="1 to 20 letters")
    made = getattr(require_pyigtl(), kind)(content, **others, timestamp=time_s, device_name=device)
    return bytes(made.pack())


class Decoder:
    """Reads messages out of the bytes of one connection, in whatever pieces they come.

    Attributes:
        dropped: How many messages were dropped, by reason.
    """

    def __init__(self) -> None:
        self._messages = require_pyigtl()
        self._left = bytearray()
        self.dropped: Counter[str] = Counter()

    def feed(self, data: bytes) -> Iterator[Received]:
        """Take some bytes, and yield the messages that they complete.

        Raises FileError if the bytes are no messages of OpenIGTLink: then nothing after them can be read, and
        the connection is of no further use.
        """
        self._left += data
        while len(self._left) >= HEADER_BYTES:
            size = struct.unpack_from("> Q", self._left, 42)[0]
            version = struct.unpack_from("> H", self._left, 0)[0]
            if size > LARGEST_BYTES or not 1 <= version <= 3:
                raise FileError(
                    f"A message claims {size} bytes and version {version}",
                    expected=f"OpenIGTLink of version 1 to 3, of at most {LARGEST_BYTES} bytes",
                    remedy="Connect a program that sends OpenIGTLink",
                )
            if len(self._left) < HEADER_BYTES + size:
                return
            header = bytes(self._left[:HEADER_BYTES])
            body = bytes(self._left[HEADER_BYTES : HEADER_BYTES + size])
            del self._left[: HEADER_BYTES + size]
            found = self._message(header, body)
            if found is not None:
                yield found

    def _message(self, header: bytes, body: bytes) -> Received | None:
        if self._messages.CRC64(body) != struct.unpack_from("> Q", header, 50)[0]:
            self.dropped[CHECKSUM] += 1
            return None
        try:
            fields = self._messages.MessageBase.parse_header(header)
            if fields["message_type"] not in KINDS:
                self.dropped[OTHER_KIND] += 1
                return None
            made = self._messages.MessageBase.create_message(fields["message_type"])
            made.unpack(fields, body)
        except Exception:
            self.dropped[DAMAGED] += 1
            return None
        name, time_s = fields["device_name"], float(fields["timestamp"])
        if fields["message_type"] == "STRING":
            return Received(name=name, time_s=time_s, text=str(made.string))
        pose = _rigid(np.asarray(made.matrix, dtype=np.float64))
        if pose is None:
            self.dropped[NOT_RIGID] += 1
            return None
        return Received(name=name, time_s=time_s, lps_from_device=pose)


def _rigid(ras_from_device: Float) -> Float | None:
    """Return a pose in LPS with the nearest rotation, None if it is not that of a rigid body."""
    if not np.isfinite(ras_from_device).all():
        return None
    left, _sizes, right = np.linalg.svd(ras_from_device[:3, :3])
    nearest = left @ right
    off = np.abs(nearest - ras_from_device[:3, :3]).max()
    # Poses on the wire have single precision, and trackers round.
    if off > 10.0 * ORTHONORMAL_TOLERANCE or np.linalg.det(ras_from_device[:3, :3]) <= 0.0:
        return None
    pose = ras_from_device.copy()
    pose[:3, :3] = nearest
    return np.asarray(LPS_FROM_RAS @ pose)
