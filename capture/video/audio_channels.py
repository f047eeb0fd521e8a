"""Which channel of which sound track is listened to: the mean of the first track's, unless more is heard elsewhere.

Channels of opposite sign (a plug wired wrongly, an adapter for balanced microphones) cancel in their mean; hum in one
of them hides what another one hears; a camera may write tracks in which nothing is.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

SILENCE_RMS = 1e-4  # -80 dB: below any real microphone's noise
CANCELLED = 0.03  # of the strongest channel's power: less is left in the mean where they cancel
LOW = 0.01  # power of differences of samples over power: below 800 Hz at 48 kHz, as hum and rumble
CLEARER = 4.0  # times as far do a channel's (a track's) loudest passages stand out, where it is taken instead
LOUD_SHARE, LOUD_BLOCKS = 0.01, 3  # the loudest passages: this share of the blocks, at least so many


@dataclass(frozen=True)
class AudioChannel:
    """What is listened to.

    Attributes:
        track: Place among the sound tracks of the file.
        channel: Of that track; None for the mean of all.
        why: What it is and why, for a note; empty for the mean of the first track.
    """

    track: int = 0
    channel: int | None = None
    why: str = ""


@dataclass
class ChannelLoudness:
    """How loud the mean of a track's channels is, and each channel, block by block.

    Attributes:
        power: Mean square of each block [blocks][1 + channels]; the mean of the channels comes first.
        steep: The same of the differences of successive samples: without hum and rumble.
    """

    power: list[Float[np.ndarray, " kinds"]] = field(default_factory=list)
    steep: list[Float[np.ndarray, " kinds"]] = field(default_factory=list)

    def add(self, values: Float[np.ndarray, "channels n"]) -> None:
        """Listen to a block; one with another number of channels than those before is left out."""
        if self.power and len(self.power[0]) != 1 + len(values):
            return
        both = np.concatenate([values.mean(axis=0, keepdims=True), values])
        self.power.append(np.square(both).mean(axis=1))
        self.steep.append(
            np.square(np.diff(both, axis=1)).mean(axis=1) if both.shape[1] > 1 else self.power[-1]
        )


def choose(tracks: list[ChannelLoudness]) -> AudioChannel:
    """The channel in which most is to be heard, where the mean of the first track's channels will not do."""
    found = [(n, heard) for n, heard in enumerate(tracks) if heard.power]
    loud = [n for n, heard in found if np.mean(heard.power, axis=0).max() > SILENCE_RMS**2]
    if not loud:
        return AudioChannel()
    clearest = {n: float(_clearness(np.array(tracks[n].steep)).max()) for n in loud}
    track = max(loud, key=clearest.__getitem__)
    if clearest[track] <= CLEARER * clearest[loud[0]]:  # hiss, or the hum of a socket without a microphone
        track = loud[0]
    heard = tracks[track]
    power, steep = np.mean(heard.power, axis=0), np.mean(heard.steep, axis=0)
    clear = _clearness(np.array(heard.steep))
    channel = 1 + int(np.argmax(np.where(power[1:] > SILENCE_RMS**2, clear[1:], -1.0)))
    where = f"track {track + 1} of {len(tracks)}"
    which = f"channel {channel} of {len(power) - 1}" + (f" in {where}" if track else "")
    if len(power) > 2 and steep[0] < CANCELLED * steep[1:].max() and power[0] < CANCELLED * power[1:].max():
        return AudioChannel(track, channel - 1, f"{which}, because the channels cancel in their mean")
    if len(power) > 2 and steep[0] < LOW * power[0] and clear[channel] > CLEARER * clear[0]:
        return AudioChannel(track, channel - 1, f"{which}, because hum hides it in the mean of all")
    return AudioChannel(
        track, None, f"{where}, because less or nothing is heard in those before" if track else ""
    )


def _clearness(steep: Float[np.ndarray, "blocks kinds"]) -> Float[np.ndarray, " kinds"]:
    """How far the loudest passages stand above the usual ones."""
    count = min(len(steep), max(LOUD_BLOCKS, round(LOUD_SHARE * len(steep))))
    loudest = np.sort(steep, axis=0)[-count:].mean(axis=0)
    return loudest / (np.median(steep, axis=0) + SILENCE_RMS**2)
