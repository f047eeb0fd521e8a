"""`bench sync`, sound: simulated rooms through the pipeline's own reader, as PCM and as AAC, and a real pair.

A room is a steady source of broadband sound (modulated noise, as rustle and chatter are), heard by two
microphones with echoes of their own, as loud together as the direct sound, and noise of their own that is ten
times as strong as all of it (-10 dB). The true delay is no multiple of a sample.
"""

from pathlib import Path

import av
import numpy as np
from jaxtyping import Float
from scipy.signal import fftconvolve

from devrf.calibration.clocks.sound import sound_delay
from devrf.capture.video.audio import RATE_HZ, Sound, read_sound
from devrf.lab.bench.accuracy.cases import Cases, not_there
from devrf.lab.bench.bench_rows import Row
from devrf.lab.simulate.render.sensor import encode_sound

SEEDS = 12
SECONDS = 12.0
SNR_DB = -10.0
ECHO_DECAY_S = 0.09  # of the amplitude: 0.6 s until it is 60 dB weaker
FIRST_ECHO_S = 0.002
LONGEST_DELAY_S = 2.0
WRONG_S = 1e-3  # another peak, not the direct sound's
CODECS = {"PCM": ("mov", "pcm_s16le", None), "AAC": ("mp4", "aac", 128_000)}
ROOM_GOAL_MS = 0.005
REAL_DELAY_S, REAL_GOAL_MS = 12.2539, 2.0  # plain correlation of the decoded samples at 16 kHz
ANCHOR = "GCC-PHAT with a parabola, 48 kHz, simulated rooms at -10 dB without a codec: below 0.005 ms, 0 of 12 wrong"


def sound(cases: Cases) -> list[Row]:
    """Errors in simulated rooms, and of the BBC's pair: as it is, and decoded and written into clips as AAC."""
    folder, rows = cases.folder("sound"), []
    for codecs in (("PCM", "PCM"), ("AAC", "AAC"), ("AAC", "PCM")):
        errors = [room_error_s(seed, codecs, folder) for seed in range(SEEDS)]
        found = 1e3 * np.abs([e for e in errors if e is not None and abs(e) < WRONG_S])
        name = f"sync/sound, room, {' against '.join(dict.fromkeys(codecs))}"
        middle, wrong = float(np.median(found)) if len(found) else None, float(SEEDS - len(found))
        rows += [
            Row(f"{name}, median", middle, "ms", anchor=ROOM_GOAL_MS).at_most(ROOM_GOAL_MS),
            Row(f"{name}, refused or wrong of {SEEDS}", wrong, "", source=ANCHOR).at_most(0.0),
        ]
    real, name = cases.real("audio_offset"), "sync/sound, real speech"
    if real is None:
        return [*rows, not_there(name, "ms", "audio_offset")]
    speech = [_read(real / f"timbl_{k}.mp3") for k in (1, 2)]
    again = [
        _written(folder / f"speech_{k}", one.samples.astype(np.float64), "AAC")
        for k, one in enumerate(speech)
    ]
    for how, (a, b) in (("MP3", speech), ("muxed as AAC", again)):
        delay_s = _delay_s(a, b)
        # The reference counts decoded samples; the files' own start times are beside that.
        off = None if delay_s is None else 1e3 * abs(delay_s - (a.start_s - b.start_s) - REAL_DELAY_S)
        row = Row(f"{name}, {how}", off, "ms", source="audio_offset: plain correlation at 16 kHz")
        rows.append(row.at_most(REAL_GOAL_MS))
    return rows


def room_error_s(seed: int, codecs: tuple[str, str], folder: Path) -> float | None:
    """Error of the delay between two microphones in a simulated room; None where it is refused."""
    rng = np.random.default_rng(seed)
    delay_s = float(rng.uniform(-LONGEST_DELAY_S, LONGEST_DELAY_S))
    heard = zip(codecs, room(rng, delay_s), strict=True)
    one, two = (_written(folder / f"{seed}_{n}", samples, codec) for n, (codec, samples) in enumerate(heard))
    found_s = _delay_s(one, two)
    return None if found_s is None else found_s - delay_s


def _delay_s(one: Sound, two: Sound) -> float | None:
    found = sound_delay(one, two)
    return found.correlation.delay_s if found is not None and found.accepted else None


def room(rng: np.random.Generator, delay_s: float) -> list[Float[np.ndarray, " n"]]:
    """What two microphones record; the first one's clip began `delay_s` before the second one's."""
    count, spare = int(SECONDS * RATE_HZ), int((LONGEST_DELAY_S + 1) * RATE_HZ)
    source = rng.standard_normal(count + 2 * spare)
    swells_s = np.arange(0, SECONDS + 10, 0.12)
    loudness = np.interp(np.arange(len(source)) / RATE_HZ, swells_s, rng.gamma(0.6, 1.0, len(swells_s)))
    hertz = np.fft.rfftfreq(len(source), 1 / RATE_HZ)
    colour = 1 / np.sqrt(1 + (hertz / 1000) ** 2)  # less and less above 1 kHz, as voices and rustle
    spectrum = np.fft.rfft(source * loudness) * colour
    out = []
    for start_s in (0.0, delay_s):
        shifted = np.fft.irfft(spectrum * np.exp(2j * np.pi * hertz * start_s), len(source))
        heard = fftconvolve(shifted, _echoes(rng))[spare : spare + count]
        noise = rng.standard_normal(count)
        level = np.sqrt(np.mean(heard**2) / np.mean(noise**2)) * 10 ** (-SNR_DB / 20)
        mixed = heard + level * noise
        out.append(0.2 * mixed / np.std(mixed))
    return out


def _echoes(rng: np.random.Generator) -> Float[np.ndarray, " n"]:
    """Impulse response of a room: the direct sound at 0, then dense decaying noise."""
    t = np.arange(int(6 * ECHO_DECAY_S * RATE_HZ)) / RATE_HZ
    tail = rng.standard_normal(len(t)) * np.exp(-t / ECHO_DECAY_S) * (t > FIRST_ECHO_S)
    tail /= np.sqrt(np.sum(tail**2))
    tail[0] = 1.0  # as loud as all echoes
    return tail


def _written(path: Path, samples: Float[np.ndarray, " n"], codec: str) -> Sound:
    """What is read of a clip that holds only this sound, its first sample at file time 0."""
    suffix, name, rate = CODECS[codec]
    path = path.with_suffix(f".{suffix}")
    with av.open(str(path), "w") as container:
        stream = container.add_stream(name, rate=RATE_HZ, layout="mono")
        if rate is not None:
            stream.bit_rate = rate
        encode_sound(container, stream, np.clip(np.round(32767 * samples), -32768, 32767).astype(np.int16))
        container.mux(stream.encode(None))
    return _read(path)


def _read(path: Path) -> Sound:
    sound = read_sound(path)
    assert sound is not None
    return sound
