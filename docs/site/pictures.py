"""The pictures of the capture guide, from the example session: `python docs/site/pictures.py`.

What is wrong in them is made of what is right by the damage that `bench stability` does
(lab/simulate/session/damage.py), so how wrong it is is known.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from devrf.capture.video.audio import read_sound
from devrf.capture.video.reader import VideoReader
from devrf.lab.simulate.session.damage import blurred, relit

DOCS = Path(__file__).resolve().parents[1]
EXAMPLE = DOCS.parent / "examples" / "workshop"
TILE = (288, 162)
RIGHT, WRONG = "#1b7f3b", "#b3261e"
# the worst of `sweep_blur`, at which cameras found no place; as a room without lamps
BLUR, DARK_STOPS = 0.04, -4.0
NEXT, FAR = 1, 12  # pictures of the sweep between two neighbours, right and wrong
PAPER = "#fbfbf8"


def main(folder: Path = DOCS) -> None:
    """Write all of them into a folder."""
    truth = json.loads((EXAMPLE / "ground_truth.json").read_text())
    plan(truth, folder / "guide-plan.png")
    sweep(folder / "guide-sweep.jpg")
    rest(folder / "guide-rest.jpg")
    board(folder / "guide-board.jpg")
    claps(truth, folder / "guide-clap.png")


def plan(truth: dict, path: Path) -> None:
    """Where sweep and cameras stand, from above: as in the example, with a sweep that ends early, and side by side."""
    stands = {name: np.array(camera["pose"]) for name, camera in truth["cams"].items()}
    moving = [stands[f"cam{n}"] for n in range(4)]
    walk = np.array(truth["static"])[:, :2, 3]
    middle = np.array(truth["claps"]["position_m"])[:2]
    subject = np.array(truth["object"]["points_m"])[..., :2].reshape(-1, 2)
    narrow = [turned(moving[1], middle, angle) for angle in (-6, -2, 2, 6)]
    panels = (
        ("right: all around, cameras spread", RIGHT, walk, moving),
        ("wrong: the sweep ends early", WRONG, walk[14:26], moving),
        ("wrong: cameras side by side", WRONG, walk, narrow),
    )
    figure, axes = plt.subplots(1, 3, figsize=(9.6, 3.4), dpi=100, facecolor=PAPER, layout="constrained")
    for axis, (title, colour, path_walked, cameras) in zip(axes, panels, strict=True):
        axis.scatter(*subject[::7].T, s=2, color="#c77700", zorder=3)
        axis.annotate("subject", middle, (0, -34), textcoords="offset points", ha="center", color="#8a5200")
        axis.plot(*path_walked.T, ".", markersize=4, color="#4a6fa5")
        for n, camera in enumerate(cameras):
            draw_camera(axis, camera, truth["K"], truth["width"], f"cam{n}" if colour == RIGHT else "")
        axis.set_title(title, color=colour, fontsize=11)
        axis.set(xlim=(-2.1, 2.3), ylim=(-2.1, 2.1), aspect="equal", xticks=[], yticks=[], facecolor=PAPER)
    figure.savefig(path)
    plt.close(figure)


def turned(world_from_camera: np.ndarray, middle: np.ndarray, angle_deg: float) -> np.ndarray:
    """A camera carried around the subject."""
    angle = np.radians(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    carried = world_from_camera.copy()
    carried[:2, :3] = turn @ world_from_camera[:2, :3]
    carried[:2, 3] = middle + turn @ (world_from_camera[:2, 3] - middle)
    return carried


def draw_camera(axis: plt.Axes, world_from_camera: np.ndarray, K: list, width: int, name: str) -> None:
    """A camera from above, with what it sees."""
    place, forward = world_from_camera[:2, 3], world_from_camera[:2, 2]
    half = np.arctan(width / 2 / K[0][0])
    edges = []
    for c, s in ((np.cos(half), np.sin(half)), (np.cos(half), -np.sin(half))):
        edges.append(place + 2.6 * np.array([[c, -s], [s, c]]) @ (forward / np.linalg.norm(forward)))
    axis.fill(*np.stack([place, *edges]).T, color="#4a6fa5", alpha=0.10, linewidth=0)
    axis.plot(*place, "s", color="black", markersize=6)
    axis.annotate(
        name,
        place,
        13 * place / np.linalg.norm(place),
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=8,
    )


def sweep(path: Path) -> None:
    """Neighbouring pictures, and what blur and too little light look like."""
    pictures = read(EXAMPLE / "static.mp4")
    here = 12
    tiles = [
        (pictures[here], "a picture of the sweep", RIGHT),
        (pictures[here + NEXT], "the next shows most of it again", RIGHT),
        (pictures[here + FAR], "as the next one: too far away", WRONG),
        (pictures[here + 4], "sharp", RIGHT),
        (blurred(pictures[here + 4], BLUR), "blurred: walked too fast", WRONG),
        (relit(pictures[here + 4], np.full(3, DARK_STOPS)), "too dark", WRONG),
    ]
    tiled(tiles, path)


def rest(path: Path) -> None:
    """A clip of a fixed camera: at rest, then moving."""
    pictures = read(EXAMPLE / "cam0.mp4")
    texts = ("first at rest, as in the sweep", "then it moves", "and stays in the picture")
    tiled([(pictures[n], text, RIGHT) for n, text in zip((2, 30, 50), texts, strict=True)], path)


def board(path: Path) -> None:
    """A board held right and wrong."""
    pictures = read(EXAMPLE / "charuco_cam0.mp4")
    tiles = [
        (pictures[4], "near and tilted", RIGHT),
        (pictures[3], "tilted the other way", RIGHT),
        (pictures[8], "into every corner", RIGHT),
        (with_board(read(EXAMPLE / "cam0.mp4")[0]), "too far away", WRONG),
        (blurred(pictures[4], BLUR), "moved too fast", WRONG),
        (pictures[0][75:255, 180:500], "hardly in the picture", WRONG),
    ]
    tiled(tiles, path)


def with_board(picture: np.ndarray) -> np.ndarray:
    """The example's board pasted into a picture, an eighth of its width, facing the camera."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    printed = cv2.aruco.CharucoBoard((8, 6), 0.06, 0.045, dictionary).generateImage((640, 480), marginSize=30)
    width, height = picture.shape[1] // 8, picture.shape[1] * 3 // 32
    small = cv2.resize(printed, (width, height), interpolation=cv2.INTER_AREA)
    out = picture.copy()
    out[150 : 150 + height, 420 : 420 + width] = small[..., None]
    return out


def claps(truth: dict, path: Path) -> None:
    """The sound of two cameras by their own clocks, and brought to one."""
    figure, axes = plt.subplots(
        2, 2, figsize=(9.6, 2.9), dpi=100, facecolor=PAPER, layout="constrained", sharex=True
    )
    for row, name in zip(axes, ("cam0", "cam1"), strict=True):
        sound = read_sound(EXAMPLE / f"{name}.mp4")
        assert sound is not None
        times = sound.start_s + np.arange(len(sound.samples)) / sound.rate_hz
        camera = truth["cams"][name]
        for axis, offset_s in zip(row, (0.0, camera["offset_s"]), strict=True):
            axis.plot(times + offset_s, sound.samples, color="#4a6fa5", linewidth=0.6)
            axis.set(yticks=[], xlim=(0, 2.7), ylim=(-1, 1), facecolor=PAPER)
        for clap_s in truth["claps"]["times_s"]:
            row[1].axvline(clap_s, color=RIGHT, linewidth=0.8, linestyle=":")
        row[0].set_ylabel(name)
    axes[0, 0].set_title("as recorded: five claps, at uneven times", fontsize=11)
    axes[0, 1].set_title("brought to one clock", fontsize=11)
    for axis in axes[1]:
        axis.set_xlabel("seconds")
    figure.savefig(path)
    plt.close(figure)


def tiled(tiles: Sequence[tuple[np.ndarray, str, str]], path: Path) -> None:
    """Pictures side by side, three a row, each with a text below."""
    width, height, line, gap = *TILE, 26, 6
    font = ImageFont.load_default(15)
    rows = -(-len(tiles) // 3)
    sheet = Image.new("RGB", (3 * width + 2 * gap, rows * (height + line) + (rows - 1) * gap), PAPER)
    draw = ImageDraw.Draw(sheet)
    for n, (picture, text, colour) in enumerate(tiles):
        x, y = n % 3 * (width + gap), n // 3 * (height + line + gap)
        sheet.paste(Image.fromarray(picture).resize(TILE, Image.Resampling.LANCZOS), (x, y))
        draw.rectangle((x, y, x + width - 1, y + height - 1), outline=colour, width=3)
        word = "right" if colour == RIGHT else "wrong"
        draw.text((x + 4, y + height + 3), f"{word}: {text}", fill=colour, font=font)
    sheet.save(path, quality=64, optimize=True, progressive=True)


def read(clip: Path) -> list[np.ndarray]:
    """All pictures of a clip [height, width, 3], RGB."""
    with VideoReader(clip) as reader:
        return [frame.rgb for frame in reader]


if __name__ == "__main__":
    main()
