"""Sound of a clip: mono, 48 kHz, float32 in [-1, 1], with the file time of its first sample.

Blocks are placed by their own presentation timestamps, so a stream that starts late, the encoder's
priming (dropped by the decoder, with the timestamps after it unchanged) and gaps keep their true times.
Resampling is linear-phase (scipy's polyphase filter), so it delays nothing.
"""

import wave
from collections.abc import Iterator
from dataclasses import dataclass
from math import gcd
from pathlib import Path

import av
import numpy as np
from av.audio.stream import AudioStream
from av.container import InputContainer
from av.error import FFmpegError
from av.packet import Packet
from jaxtyping import Float
from scipy.signal import resample_poly

from devrf.capture.system.errors import CaptureError
from devrf.capture.system.limits import check_span
from devrf.capture.video.audio_channels import SILENCE_RMS, AudioChannel, ChannelLoudness, choose
from devrf.capture.video.media import open_media, origin_s

RATE_HZ = 48_000  # what nearly all cameras record; 21 microseconds a sample
JITTER_S = 1e-3  # containers with millisecond time bases (mkv) round by half a millisecond
INT16_MAX = 32767


@dataclass(frozen=True)
class Sound:
    """Mono sound.

    Attributes:
        samples: Amplitudes [n] in [-1, 1].
        rate_hz: Samples per second.
        start_s: File time of sample 0, seconds.
        recorded_hz: Samples per second in the file it was read from, or None.
        taken: Which of several channels or tracks it is and why, where it is not the mean of the first track's.
    """

    samples: Float[np.ndarray, " n"]
    rate_hz: int
    start_s: float
    recorded_hz: int | None = None
    taken: str = ""

    @property
    def end_s(self) -> float:
        """File time of the end, seconds."""
        return self.start_s + len(self.samples) / self.rate_hz

    @property
    def silent(self) -> bool:
        """Whether nothing can be heard (a muted or missing microphone)."""
        if not len(self.samples):
            return True
        return float(np.sqrt(np.mean(np.square(self.samples, dtype=np.float64)))) < SILENCE_RMS


def read_sound(path: Path) -> Sound | None:
    """Decode the sound of a file as mono; None where the file has none.

    It is the mean of the first track's channels, or what is clearer (`audio_channels`).

    Raises:
        InputError: If the file is missing or not a media file.
        CaptureError: If there is a sound track, but nothing of any decodes, or it is longer than any recording.
    """
    with open_media(path) as container:
        tracks = container.streams.audio
        if not tracks:
            return None
        several = len(tracks) > 1 or (tracks[0].channels if tracks[0].codec_context else 1) > 1
        choice = _listen(path, container) if several else AudioChannel()
    with open_media(path) as container:
        stream = container.streams.audio[choice.track]
        blocks: list[tuple[float, np.ndarray]] = []
        native_hz, failure = 0, ""
        try:
            for block in container.decode(stream):
                if block.time is None or not block.samples:
                    continue
                native_hz = native_hz or block.sample_rate
                values = _channels(block)
                one = choice.channel is not None and choice.channel < len(values)
                samples = values[choice.channel] if one else values.mean(axis=0)
                blocks.append((block.time - origin_s(container), samples))
                check_span(path, abs(blocks[-1][0] - blocks[0][0]))
        except FFmpegError as error:
            failure = f" ({error.strerror})"  # what decoded before the damage is used
    if not blocks:
        wrong = f"{path}: has a sound stream, but nothing of it decodes{failure}"
        raise CaptureError("sound-undecodable", f"{wrong}; copy the clip from the camera again")
    samples, start_s = _place(blocks, native_hz)
    if native_hz != RATE_HZ:
        factor = gcd(native_hz, RATE_HZ)
        samples = resample_poly(samples, RATE_HZ // factor, native_hz // factor).astype(np.float32)
    return Sound(samples, RATE_HZ, start_s, native_hz, choice.why)


def heard(path: Path) -> Sound | None:
    """The sound of a file; None where there is nothing to hear, or what there is cannot be decoded.

    Raises:
        InputError: As `read_sound`.
    """
    try:
        sound = read_sound(path)
    except CaptureError:
        return None
    return None if sound is None or sound.silent else sound


def _listen(path: Path, container: InputContainer) -> AudioChannel:
    """Listen to all channels of all tracks, without keeping what is heard, and choose."""
    tracks = [s for s in container.streams.audio if s.codec_context is not None]
    heard = {s.index: ChannelLoudness() for s in container.streams.audio}
    damaged: set[int] = set()
    first_s: float | None = None
    for packet in _packets(container, tracks):
        if packet.stream.index in damaged:
            continue
        try:
            for block in packet.stream.codec_context.decode(packet):
                if block.time is None or not block.samples:
                    continue
                first_s = block.time if first_s is None else first_s
                check_span(path, abs(block.time - first_s))
                heard[packet.stream.index].add(_channels(block))
        except FFmpegError:
            damaged.add(packet.stream.index)
    return choose(list(heard.values()))


def _packets(container: InputContainer, tracks: list[AudioStream]) -> Iterator[Packet]:
    """Packets of sound up to the first damage of the file."""
    try:
        yield from container.demux(*tracks)
    except FFmpegError:
        return


def write_wav(path: Path, sound: Sound) -> None:
    """Write 16-bit mono PCM; the start time is not part of the format and must be kept beside it."""
    pcm = np.round(np.clip(sound.samples, -1, 1) * INT16_MAX).astype("<i2")
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(sound.rate_hz)
        file.writeframes(pcm.tobytes())


def read_wav(path: Path, start_s: float = 0.0) -> Sound:
    """Read what `write_wav` wrote.

    Raises:
        CaptureError: If it is not 16-bit mono PCM.
    """
    try:
        with wave.open(str(path), "rb") as file:
            layout = (file.getnchannels(), file.getsampwidth())
            if layout != (1, 2):
                text = f"{path}: {layout[0]} channels of {layout[1]} bytes, expected mono 16 bit"
                raise CaptureError("sound-wrong", text)
            pcm = np.frombuffer(file.readframes(file.getnframes()), dtype="<i2")
            return Sound(pcm.astype(np.float32) / INT16_MAX, file.getframerate(), start_s)
    except (wave.Error, EOFError) as error:
        raise CaptureError("file-damaged", f"{path}: not a wav file ({error})") from None


def _channels(block: av.AudioFrame) -> Float[np.ndarray, "channels n"]:
    """Its channels [channels, n], float32 in [-1, 1]."""
    values = block.to_ndarray()
    if not block.format.is_planar:
        values = values.reshape(-1, block.layout.nb_channels).T
    if values.dtype == np.uint8:
        return (values.astype(np.float32) - 128) / 128
    if np.issubdtype(values.dtype, np.integer):
        return values.astype(np.float32) / float(2 ** (8 * values.itemsize - 1))
    return values.astype(np.float32)


def _place(blocks: list[tuple[float, np.ndarray]], rate_hz: int) -> tuple[Float[np.ndarray, " n"], float]:
    """Blocks joined at their own times: rounding is ignored, gaps become silence, overlaps are cut."""
    start_s = blocks[0][0]
    pieces: list[np.ndarray] = []
    filled = 0
    for time_s, values in blocks:
        at = round((time_s - start_s) * rate_hz)
        if at > filled + JITTER_S * rate_hz:
            pieces.append(np.zeros(at - filled, np.float32))
            filled = at
        elif at < filled - JITTER_S * rate_hz:
            values = values[filled - at :]
        pieces.append(values)
        filled += len(values)
    return np.concatenate(pieces), start_s
