"""Which packets of an interlaced clip hold the second field of a picture, whose first field came in the packet before.

Camcorders (AVCHD, HDV) may code each field of a picture by itself; two packets then give one picture. Only headers are
read: H.264's slice header (ITU-T H.264, 7.3.3) and MPEG-2's picture header (ITU-T H.262, 6.2.3).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

# they name their chroma
HIGH_PROFILES = frozenset((44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244))
SLICES, SPS = (1, 5), 7  # kinds of NAL units
HEADER_BYTES = 64  # a slice's first fields take less
SPS_BYTES = 1024
CODING_EXTENSION = 8  # of MPEG-2's extensions, the one of a picture's coding
FRAME = 3  # MPEG-2's picture_structure of a whole picture

Field = tuple[int, int]  # number of the picture it belongs to, and whether it is the top or the bottom one
Reader = Callable[[bytes], Field | None]


class SecondFields:
    """Told of packets in decoding order, says which hold a second field."""

    def __init__(self, codec: str, extradata: bytes | None) -> None:
        self._read = _reader(codec, extradata or b"")
        self._first: Field | None = None

    @property
    def possible(self) -> bool:
        """Whether the clip may have fields at all; else no packet needs to be looked at."""
        return self._read is not None

    def second(self, packet: bytes) -> bool:
        """Whether a packet holds the other field of the picture whose first one came just before."""
        field = None if self._read is None else self._read(packet)
        first, self._first = self._first, field
        if first is None or field is None or first[0] != field[0] or first[1] == field[1]:
            return False
        self._first = None
        return True


@dataclass(frozen=True)
class _Sequence:
    """What H.264's sequence parameter set says that is needed to read a slice header."""

    fields: bool
    number_bits: int
    planes: bool


class _Bits:
    """Bits of a NAL unit, without its emulation prevention."""

    def __init__(self, data: bytes) -> None:
        data = data.replace(b"\0\0\3", b"\0\0")
        self._value, self._left = int.from_bytes(data, "big"), 8 * len(data)

    def u(self, count: int) -> int:
        """An unsigned number of so many bits; zeros follow the end."""
        self._left -= count
        value = self._value >> self._left if self._left >= 0 else 0
        return value & ((1 << count) - 1)

    def ue(self) -> int:
        """An unsigned Exp-Golomb number."""
        zeros = 0
        while self._left > 0 and not self.u(1):
            zeros += 1
        return (1 << zeros) - 1 + (self.u(zeros) if zeros else 0)

    def se(self) -> int:
        """A signed Exp-Golomb number."""
        value = self.ue()
        return (value + 1) // 2 if value % 2 else -value // 2


def _reader(codec: str, extradata: bytes) -> Reader | None:
    """What reads the field of a packet; None where the clip has none."""
    if codec == "mpeg2video":
        return _mpeg2_field
    if codec != "h264":
        return None
    length_bytes = 1 + (extradata[4] & 3) if len(extradata) > 6 and extradata[0] == 1 else 0
    head = _from_avcc(extradata) if length_bytes else _annex_b(extradata)
    sequence = next((_sequence(unit) for unit in head if unit and unit[0] & 31 == SPS), None)
    if sequence is None or not sequence.fields:
        return None
    return lambda packet: _h264_field(_units(packet, length_bytes), sequence)


def _mpeg2_field(packet: bytes) -> Field | None:
    head = packet.find(b"\0\0\1\0")
    extensions = (at for at in _places(packet, b"\0\0\1\xb5") if packet[at + 4 : at + 5] >= b"\x80")
    coding = next((at for at in extensions if packet[at + 4] >> 4 == CODING_EXTENSION), -1)
    if head < 0 or coding < 0 or len(packet) < max(head + 6, coding + 7):
        return None
    structure = packet[coding + 6] & 3
    number = packet[head + 4] << 2 | packet[head + 5] >> 6
    return None if structure == FRAME else (number, structure)


def _h264_field(units: Iterator[bytes], sequence: _Sequence) -> Field | None:
    for unit in units:
        if unit and unit[0] & 31 in SLICES:
            bits = _Bits(unit[1:HEADER_BYTES])
            for _ in range(3):  # first macroblock, type of slice, parameter set
                bits.ue()
            if sequence.planes:
                bits.u(2)
            number = bits.u(sequence.number_bits)
            return (number, bits.u(1)) if bits.u(1) else None
    return None


def _sequence(unit: bytes) -> _Sequence:
    bits = _Bits(unit[1:SPS_BYTES])
    profile = bits.u(8)
    bits.u(16)
    bits.ue()
    planes = False
    if profile in HIGH_PROFILES:
        chroma = bits.ue()
        planes = chroma == 3 and bool(bits.u(1))
        bits.ue()
        bits.ue()
        bits.u(1)
        if bits.u(1):
            for n in range(12 if chroma == 3 else 8):
                if bits.u(1):
                    _skip_scaling_list(bits, 16 if n < 6 else 64)
    number_bits = bits.ue() + 4
    order = bits.ue()
    if order == 0:
        bits.ue()
    elif order == 1:
        bits.u(1)
        bits.se()
        bits.se()
        for _ in range(min(bits.ue(), 255)):
            bits.se()
    bits.ue()
    bits.u(1)
    bits.ue()
    bits.ue()
    return _Sequence(not bits.u(1), number_bits, planes)


def _skip_scaling_list(bits: _Bits, size: int) -> None:
    last = following = 8
    for _ in range(size):
        if following:
            following = (last + bits.se()) % 256
        last = following or last


def _units(packet: bytes, length_bytes: int) -> Iterator[bytes]:
    """Beginnings of the NAL units of a packet."""
    if not length_bytes:
        yield from _annex_b(packet)
        return
    at = 0
    while at + length_bytes < len(packet):
        size = int.from_bytes(packet[at : at + length_bytes], "big")
        at += length_bytes
        yield packet[at : at + min(size, SPS_BYTES)]
        at += size


def _annex_b(data: bytes) -> Iterator[bytes]:
    for at in _places(data, b"\0\0\1"):
        yield data[at + 3 : at + 3 + SPS_BYTES]


def _from_avcc(extradata: bytes) -> Iterator[bytes]:
    """Sequence parameter sets of an avcC box (ISO/IEC 14496-15, 5.3.3.1)."""
    at = 6
    for _ in range(extradata[5] & 31):
        size = int.from_bytes(extradata[at : at + 2], "big")
        yield extradata[at + 2 : at + 2 + size]
        at += 2 + size


def _places(data: bytes, start: bytes) -> Iterator[int]:
    at = data.find(start)
    while at >= 0:
        yield at
        at = data.find(start, at + len(start))
